//! The program `endless`.

use std::io::Write;
use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    match std::env::current_exe() {
        Ok(executable) => endless_gym_cli::main(arguments, &[executable.into()]).into(),
        Err(error) => {
            let _ = writeln!(std::io::stderr(), "endless: cannot find the program's own file: {error}");
            ExitCode::FAILURE
        }
    }
}
