//! Lints, tests and measurements of the crates.

use std::ffi::OsStr;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::python;
use crate::shell::{self, describe, output, run, succeeds, target, workspace};

/// A fixed seed of the property tests, so that a failure is due to a change.
const PROPERTY_SEED: &str = "20251122";

fn cargo(arguments: &[&str]) -> Result<(), String> {
    let mut cargo = shell::cargo(arguments);
    // `cargo test` of the workspace builds the examples.
    run(cargo.env("PROPTEST_RNG_SEED", PROPERTY_SEED).env("ENDLESS_EXAMPLES_BUILT", "1"))
}

pub fn format() -> Result<(), String> {
    cargo(&["fmt", "--all", "--check"])
}

pub fn clippy() -> Result<(), String> {
    cargo(&["clippy", "--workspace", "--all-targets", "--locked", "--", "--deny", "warnings"])
}

/// Lints what is left without features, which needs builds of the dependencies of its own.
pub fn clippy_features() -> Result<(), String> {
    for (package, features) in [("endless-gym-core", ""), ("endless-gym", ""), ("endless-gym", "service")] {
        let selection = format!("clippy --locked --package {package} --no-default-features --features={features}");
        cargo(&selection.split(' ').chain(["--", "--deny", "warnings"]).collect::<Vec<_>>())?;
    }
    Ok(())
}

/// All tests of the workspace that are not ignored.
pub fn test() -> Result<(), String> {
    cargo(&["test", "--workspace", "--locked", "--no-fail-fast"])
}

/// The ignored tests (slow ones, and those that the machine may forbid), except those that need a browser or the original.
pub fn test_ignored() -> Result<(), String> {
    let all = "test --workspace --locked --no-fail-fast --lib --tests --exclude endless-gym-web --";
    let mut arguments = Vec::from_iter(all.split(' ').chain("--ignored --skip browser:: --skip live::".split(' ')));
    if !succeeds(Command::new("unshare").args(["--mount", "--map-root-user", "true"])) {
        not_run("without permission to create mount namespaces: tests in shared memory of other sizes")?;
        let skipped = ["inside_", "two_directories_of_one_path"];
        arguments.extend(skipped.iter().flat_map(|name| ["--skip", name]));
    }
    if !rustix::process::geteuid().is_root() {
        not_run("since this is not root: tests with segments of another user")?;
        arguments.extend(["--skip", "as_root_"]);
    }
    cargo(&arguments)
}

/// Says what is not run, and why; an error if the environment variable CI is `true`.
pub fn not_run(what: &str) -> Result<(), String> {
    println!("not run, {what}");
    if std::env::var("CI").as_deref() == Ok("true") { Err(format!("not run, {what}")) } else { Ok(()) }
}

/// Compares with the original: with a fixed seed, or `steps` steps of each environment with new seeds, optimised, since
/// they take long.
pub fn test_original(steps: Option<u64>) -> Result<(), String> {
    let mut cargo = shell::cargo(&["test", "--workspace", "--locked", "--test", "integration"]);
    match steps {
        Some(steps) => cargo.arg("--release").env("ENDLESS_LIVE_STEPS", steps.to_string()),
        None => cargo.env("PROPTEST_RNG_SEED", PROPERTY_SEED),
    };
    let (popgym, original) = (python::original(true)?, python::original(false)?);
    cargo.env("ENDLESS_POPGYM_PYTHON", popgym).env("ENDLESS_ORIGINAL_PYTHON", original);
    run(cargo.args(["--", "--ignored", "--nocapture", "live::"]))
}

/// Runs one or all fuzz targets with new seeds for at least `minutes`; optimised, since it takes long.
pub fn fuzz(only: Option<&str>, minutes: u64) -> Result<(), String> {
    let start = Instant::now();
    loop {
        let mut tests =
            vec!["test", "--release", "--locked", "--package", "endless-gym-fuzz", "--test", "properties", "--"];
        tests.extend(only.map(|target| ["--exact", target]).into_iter().flatten());
        run(shell::cargo(&tests).env("PROPTEST_CASES", "5000").env_remove("PROPTEST_RNG_SEED"))?;
        if start.elapsed() >= Duration::from_secs(60 * minutes) {
            return Ok(());
        }
    }
}

/// Checks the models of the worker threads under loom, in a separate target directory, since the flags apply to all crates.
pub fn loom() -> Result<(), String> {
    let mut cargo =
        shell::cargo(&["test", "--locked", "--package", "endless-gym-core", "--lib", "loom_", "--target-dir"]);
    cargo.arg(target()?.join("loom")).env("RUSTFLAGS", "--cfg loom --cfg crossbeam_loom");
    run(cargo.env("CARGO_PROFILE_TEST_OPT_LEVEL", "2"))
}

/// Builds the program of `tests/faults` and the engine that it starts, and runs one of the program's commands. A failure prints the
/// command line that repeats it.
pub fn faults(command: &str, arguments: &[impl AsRef<OsStr>]) -> Result<(), String> {
    // With all tests, as they were built before: alone, the programs would have dependencies with other features.
    cargo(&["build", "--locked", "--workspace", "--bins", "--tests"])?;
    run(Command::new(target()?.join("debug/endless-gym-faults")).arg(command).args(arguments))
}

/// Environment steps that the benchmark counts.
const STEPS: u64 = 250 * 16;

/// Allowed deviation, since other CPUs copy memory with other instructions.
const MARGIN_PERCENT: u64 = 10;

/// Counts the instructions of a step, which do not depend on the machine's load, and compares them with the budgets;
/// with `record`, writes the counts as the new budgets.
pub fn instructions(record: bool) -> Result<(), String> {
    let file = workspace().join("engine/memory-gym/benches/instructions.txt");
    let text = std::fs::read_to_string(&file).map_err(describe(&file))?;
    let lines: Vec<_> = text.lines().map(|line| line.split_once(' ').unwrap_or((line, "0"))).collect();
    // Callgrind uses one core.
    let counts: Vec<Result<u64, String>> = std::thread::scope(|scope| {
        let counting: Vec<_> = lines.iter().map(|(id, _)| scope.spawn(|| count(id))).collect();
        counting.into_iter().map(|count| count.join().map_err(|_| "a count panicked".to_owned()).flatten()).collect()
    });
    let (mut recorded, mut failures) = (String::new(), String::new());
    println!("{:30} {:>24} {:>8}", "environment", "instructions a step", "budget");
    for ((id, budget), count) in lines.into_iter().zip(counts) {
        let budget: u64 = budget.parse().map_err(describe(&file))?;
        let count = count? / STEPS;
        println!("{id:30} {count:24} {budget:8}");
        recorded += &format!("{id} {count}\n");
        if count.abs_diff(budget) * 100 > budget * MARGIN_PERCENT {
            failures += &format!("{id}: {count} instructions a step, the budget is {budget} ± {MARGIN_PERCENT} %\n");
        }
    }
    if record {
        return std::fs::write(&file, recorded).map_err(describe(&file));
    }
    let hint = "if the change is intended, record it: cargo xtask instructions --record";
    if failures.is_empty() { Ok(()) } else { Err(failures + hint) }
}

/// Instructions of all counted steps of an environment, measured by callgrind.
fn count(id: &str) -> Result<u64, String> {
    const VALGRIND: &str = "valgrind --tool=callgrind --callgrind-out-file=/dev/null --log-fd=1 --toggle-collect=instructions::counted_steps";
    // Keep the C library from using `rep movsb` and `rep stosb`, since callgrind counts each of their bytes as an instruction.
    const TUNABLES: &str = "glibc.cpu.x86_rep_movsb_threshold=1000000000:glibc.cpu.x86_rep_stosb_threshold=1000000000";
    let runner = format!("target.'cfg(all())'.runner=\"{VALGRIND}\"");
    let mut bench = shell::cargo(&["bench", "--locked", "--config", &runner, "--package", "endless-gym-memory-gym"]);
    let printed = output(bench.args(["--bench", "instructions", "--", id]).env("GLIBC_TUNABLES", TUNABLES))?;
    let collected = printed.lines().find_map(|line| Some(line.split_once("Collected :")?.1.trim()));
    let count = collected.and_then(|count| count.parse().ok()).filter(|count| *count > 0);
    count.ok_or_else(|| format!("callgrind counted no instructions of {id}\n{printed}"))
}
