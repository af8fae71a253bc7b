//! `cargo xtask faults` and `cargo xtask soak`: the program of `tests/faults`.

use std::process::Command;

use crate::cargo;
use crate::venv::{execute, target};

/// The faults of the tests, always the same. A failure prints the command line that repeats it.
pub fn test() -> Result<(), String> {
    run("faults", &["--minutes", "2", "--seed", "1"].map(str::to_owned))
}

/// Builds the program and the engine that it starts, and runs one of its commands.
pub fn run(command: &str, arguments: &[String]) -> Result<(), String> {
    cargo::run(&["build", "--locked", "--package", "endless-gym", "--package", "endless-gym-faults", "--bins"])?;
    let program = target()?.join("debug/endless-gym-faults");
    execute(Command::new(program).arg(command).args(arguments))
}
