//! The `endless` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    match std::env::current_exe() {
        Ok(itself) => endless_gym::cli::main(arguments, &[itself.into()]),
        Err(error) => {
            eprintln!("endless: cannot find its own program file: {error}");
            ExitCode::FAILURE
        }
    }
}
