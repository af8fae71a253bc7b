//! Runs of cargo.

use std::process::Command;
use std::time::Instant;

use crate::original;

/// Compares `steps` steps of each environment with the original, from new seeds; optimised, since it is long.
pub fn live(steps: u64) -> Result<(), String> {
    let arguments = ["test", "--release", "--locked", "--test", "live", "--", "--nocapture"];
    run(&arguments, &[("ENDLESS_LIVE_STEPS", &steps.to_string())])
}

/// Runs the property tests with `cases` cases each, from new seeds; optimised, since they are long.
pub fn properties(cases: u32) -> Result<(), String> {
    let arguments = ["test", "--release", "--workspace", "--locked", "--lib", "--tests"];
    run(&arguments, &[("PROPTEST_CASES", &cases.to_string())])
}

/// The cargo that runs this, so that toolchain and settings are the same.
pub fn command() -> Command {
    Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
}

/// Runs cargo with the original environments, whose Python `ENDLESS_ORIGINAL_PYTHON` names.
pub fn run(arguments: &[&str], variables: &[(&str, &str)]) -> Result<(), String> {
    let python = original::python()?;
    let line = format!("cargo {}", arguments.join(" "));
    println!("==> {line}");
    let start = Instant::now();
    let status = command()
        .args(arguments)
        .env("RUSTDOCFLAGS", "--deny warnings")
        .env("ENDLESS_ORIGINAL_PYTHON", &python)
        .envs(variables.iter().copied())
        .status()
        .map_err(|error| format!("`{line}` cannot be run: {error}"))?;
    if !status.success() {
        return Err(format!("`{line}` failed: {status}"));
    }
    println!("    {:.1} s", start.elapsed().as_secs_f64());
    Ok(())
}
