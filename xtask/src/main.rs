//! The project's chores: `cargo xtask test` passes all tests.

mod instructions;
mod original;
mod python;
mod venv;

use std::process::{Command, ExitCode};
use std::time::Instant;

const HELP: &str = "\
cargo xtask test                 check the format, lint, and run all tests, Rust's and Python's
cargo xtask python               build the Python package, check it, and run its tests alone
cargo xtask instructions         count the instructions of a step, and compare with what is recorded (--record records)
cargo xtask bench [ARGS]         compare steps per second with the original's and others' (--help shows ARGS)
cargo xtask live [STEPS]         compare STEPS steps of each environment with the original (default 100000)
cargo xtask original             set up the original in a virtual environment and print the path of its Python";

/// What `cargo xtask test` runs, in this order; the first that fails ends it.
const TEST: &[&[&str]] = &[
    &["fmt", "--all", "--check"],
    &["clippy", "--workspace", "--all-targets", "--locked", "--", "--deny", "warnings"],
    &["test", "--workspace", "--locked"],
    &["doc", "--workspace", "--no-deps", "--locked"],
];

/// The live comparison alone, optimised, since it is long.
const LIVE: &[&str] = &["test", "--release", "--locked", "--test", "live", "--", "--nocapture"];
const LIVE_STEPS: &str = "100000";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let done = match arguments[..] {
        ["test"] => run(TEST, &[])
            .and_then(|()| instructions::run(false))
            .and_then(|()| python::test())
            .map(|()| println!("all passed")),
        ["python"] => python::test(),
        ["instructions"] => instructions::run(false),
        ["instructions", "--record"] => instructions::run(true),
        ["bench", ref arguments @ ..] => python::bench(arguments),
        ["live"] => run(&[LIVE], &[("ENDLESS_LIVE_STEPS", LIVE_STEPS)]),
        ["live", steps] => run(&[LIVE], &[("ENDLESS_LIVE_STEPS", steps)]),
        ["original"] => original::python().map(|python| println!("{}", python.display())),
        [] | ["help" | "--help" | "-h"] => {
            println!("{HELP}");
            Ok(())
        }
        _ => Err(format!("there is no `{}`; there is\n{HELP}", arguments.join(" "))),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("xtask: {message}");
            ExitCode::FAILURE
        }
    }
}

/// Runs cargo with each of the argument lists, beside a Python that has the original.
fn run(commands: &[&[&str]], variables: &[(&str, &str)]) -> Result<(), String> {
    let python = original::python()?;
    for arguments in commands {
        let line = format!("cargo {}", arguments.join(" "));
        println!("==> {line}");
        let start = Instant::now();
        // The cargo that runs this, so that toolchain and settings are the same.
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        let status = Command::new(cargo)
            .args(*arguments)
            .env("RUSTDOCFLAGS", "--deny warnings")
            .env("ENDLESS_ORIGINAL_PYTHON", &python)
            .envs(variables.iter().copied())
            .status()
            .map_err(|error| format!("`{line}` cannot be run: {error}"))?;
        if !status.success() {
            return Err(format!("`{line}` failed: {status}"));
        }
        println!("    {:.1} s", start.elapsed().as_secs_f64());
    }
    Ok(())
}
