//! The program `endless`.

use std::process::ExitCode;

fn main() -> ExitCode {
    endless_gym::program(endless_gym::environments())
}
