//! Runs of cargo.

use std::process::Command;

use crate::original;
use crate::venv::execute;

/// A seed of the property tests: a failure in the tests is due to a change.
const PROPERTY_SEED: &str = "20251122";

/// Runs cargo as the tests do.
pub fn run(arguments: &[&str]) -> Result<(), String> {
    println!("==> cargo {}", arguments.join(" "));
    execute(with_original(arguments)?.env("PROPTEST_RNG_SEED", PROPERTY_SEED).env("RUSTDOCFLAGS", "--deny warnings"))
}

/// Runs one test that is ignored where the machine does not permit it.
pub fn ignored_test(program: &str, name: &str) -> Result<(), String> {
    run(&["test", "--locked", "--test", program, "--", "--ignored", "--exact", name])
}

/// Compares `steps` steps of each environment with the original, from new seeds; optimised, since it is long.
pub fn live(steps: u64) -> Result<(), String> {
    original::python()?;
    let arguments = ["test", "--release", "--locked", "--test", "live", "--", "--include-ignored", "--nocapture"];
    execute(with_original(&arguments)?.env("ENDLESS_LIVE_STEPS", steps.to_string()))
}

/// Runs the property tests with `cases` cases each, from new seeds; optimised, since they are long.
pub fn properties(cases: u32) -> Result<(), String> {
    original::python()?;
    let arguments = ["test", "--release", "--workspace", "--locked", "--lib", "--tests"];
    execute(with_original(&arguments)?.env("PROPTEST_CASES", cases.to_string()))
}

/// The cargo that runs this, so that toolchain and settings are the same.
pub fn command() -> Command {
    Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
}

/// Cargo with the path of the original's Python, whether or not it has been set up.
fn with_original(arguments: &[&str]) -> Result<Command, String> {
    let mut command = command();
    command.args(arguments).env("ENDLESS_ORIGINAL_PYTHON", original::path()?);
    Ok(command)
}
