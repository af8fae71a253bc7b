//! The project's chores: `cargo xtask test` passes all tests.

use std::process::{Command, ExitCode};
use std::time::Instant;

const HELP: &str = "\
cargo xtask test    check the format, lint, and run all tests";

/// What `cargo xtask test` runs, in this order; the first that fails ends it.
const TEST: &[&[&str]] = &[
    &["fmt", "--all", "--check"],
    &["clippy", "--workspace", "--all-targets", "--locked", "--", "--deny", "warnings"],
    &["test", "--workspace", "--locked"],
    &["doc", "--workspace", "--no-deps", "--locked"],
];

fn main() -> ExitCode {
    match std::env::args().nth(1).as_deref() {
        Some("test") => test(),
        None | Some("help" | "--help" | "-h") => {
            println!("{HELP}");
            ExitCode::SUCCESS
        }
        Some(other) => {
            eprintln!("xtask: there is no `{other}`; there is\n{HELP}");
            ExitCode::FAILURE
        }
    }
}

fn test() -> ExitCode {
    for arguments in TEST {
        let line = format!("cargo {}", arguments.join(" "));
        println!("==> {line}");
        let start = Instant::now();
        // The path of the cargo that runs this, so that toolchain and settings are the same.
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        let status = Command::new(cargo).args(*arguments).env("RUSTDOCFLAGS", "--deny warnings").status();
        match status {
            Ok(status) if status.success() => println!("    {:.1} s", start.elapsed().as_secs_f64()),
            Ok(status) => {
                eprintln!("xtask: `{line}` failed: {status}");
                return ExitCode::FAILURE;
            }
            Err(error) => {
                eprintln!("xtask: `{line}` cannot be run: {error}");
                return ExitCode::FAILURE;
            }
        }
    }
    println!("all checks passed");
    ExitCode::SUCCESS
}
