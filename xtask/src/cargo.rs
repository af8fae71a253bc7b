//! Runs of cargo.

use std::process::Command;
use std::time::{Duration, Instant};

use crate::original;
use crate::venv::{execute, target};

/// A seed of the property tests: a failure in the tests is due to a change.
const PROPERTY_SEED: &str = "20251122";

/// Runs cargo as the tests do.
pub fn run(arguments: &[&str]) -> Result<(), String> {
    println!("==> cargo {}", arguments.join(" "));
    let mut cargo = with_original(arguments)?;
    cargo.env("PROPTEST_RNG_SEED", PROPERTY_SEED).env("RUSTDOCFLAGS", "--deny warnings");
    // `cargo test` of the workspace builds the examples.
    execute(cargo.env("ENDLESS_EXAMPLES_BUILT", "1"))
}

/// Runs one test that is ignored where the machine does not permit it.
pub fn ignored_test(program: &str, name: &str) -> Result<(), String> {
    run(&["test", "--locked", "--test", program, "--", "--ignored", "--exact", name])
}

/// Compares `steps` steps of each environment with the original, from new seeds; optimised, since it is long.
pub fn live(steps: u64) -> Result<(), String> {
    original::python()?;
    let arguments =
        ["test", "--release", "--locked", "--test", "integration", "--", "--include-ignored", "--nocapture", "live::"];
    execute(with_original(&arguments)?.env("ENDLESS_LIVE_STEPS", steps.to_string()))
}

/// Runs the property tests with `cases` cases each, from new seeds; optimised, since they are long.
pub fn properties(cases: u32) -> Result<(), String> {
    original::python()?;
    let arguments = ["test", "--release", "--workspace", "--locked", "--lib", "--tests"];
    execute(with_original(&arguments)?.env("PROPTEST_CASES", cases.to_string()))
}

/// Runs the fuzz targets, or one of them, from new seeds for at least `minutes`; optimised, since it is long.
pub fn fuzz(only: Option<&str>, minutes: u64) -> Result<(), String> {
    let start = Instant::now();
    let tests = ["test", "--release", "--locked", "--package", "endless-gym-fuzz", "--test", "properties", "--"];
    loop {
        let only = only.map(|target| ["--exact", target]).into_iter().flatten();
        execute(command().args(tests).args(only).env("PROPTEST_CASES", "5000").env_remove("PROPTEST_RNG_SEED"))?;
        if start.elapsed() >= Duration::from_secs(60 * minutes) {
            return Ok(());
        }
    }
}

/// Checks the models of the worker threads under loom. The flags apply to all crates, hence a target directory of their own.
pub fn loom() -> Result<(), String> {
    let tests = ["test", "--locked", "--package", "endless-gym-core", "--lib", "loom_"];
    execute(
        command()
            .args(tests)
            .arg("--target-dir")
            .arg(target()?.join("loom"))
            .env("RUSTFLAGS", "--cfg loom --cfg crossbeam_loom")
            .env("CARGO_PROFILE_TEST_OPT_LEVEL", "2"),
    )
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
