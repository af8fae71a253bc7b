//! Development tasks: `cargo xtask test` runs all tests.

mod instructions;
mod modules;
mod original;
mod python;
mod venv;
mod wasm;

use std::process::{Command, ExitCode, Stdio};
use std::time::Instant;

const HELP: &str = "\
cargo xtask test                 check formatting, lint, and run all tests, Rust's and Python's
cargo xtask python               build the Python package, lint it, and run its tests alone
cargo xtask modules              check that the files of a crate do not import each other in cycles
cargo xtask wasm                 build the core for wasm32-unknown-unknown
cargo xtask instructions         count the instructions of a step and compare with the budgets (--record: record new budgets)
cargo xtask bench [ARGS]         compare steps per second with the original's and others' (--help lists ARGS)
cargo xtask live [STEPS]         compare STEPS steps of each environment with the original, from new seeds (default 100000)
cargo xtask properties [CASES]   run the property tests with CASES cases each, from new seeds (default 2000)
cargo xtask original             set up the original in a virtual environment and print the path of its Python";

/// What `cargo xtask test` runs, in this order; the first failure ends it.
const TEST: &[&[&str]] = &[
    &["fmt", "--all", "--check"],
    &["clippy", "--workspace", "--all-targets", "--locked", "--", "--deny", "warnings"],
    &["clippy", "--package", "endless-gym-core", "--no-default-features", "--locked", "--", "--deny", "warnings"],
    &["test", "--workspace", "--locked"],
    &["doc", "--workspace", "--no-deps", "--locked"],
];

/// The seed of the property tests in `cargo xtask test`: a failure there is due to a change.
const PROPERTY_SEED: (&str, &str) = ("PROPTEST_RNG_SEED", "20251122");

/// The property tests alone, optimised, since they are long.
const PROPERTIES: &[&str] = &["test", "--release", "--workspace", "--locked", "--lib", "--tests"];
const PROPERTY_CASES: &str = "2000";

/// The live comparison alone, optimised, since it is long.
const LIVE: &[&str] = &["test", "--release", "--locked", "--test", "live", "--", "--nocapture"];
const LIVE_STEPS: &str = "100000";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let done = match arguments[..] {
        ["test"] => run(TEST, &[PROPERTY_SEED])
            .and_then(|()| mount_namespaces())
            .and_then(|()| modules::check())
            .and_then(|()| wasm::check())
            .and_then(|()| instructions::run(false))
            .and_then(|()| python::test())
            .map(|()| println!("all passed")),
        ["python"] => python::test(),
        ["instructions"] => instructions::run(false),
        ["instructions", "--record"] => instructions::run(true),
        ["bench", ref arguments @ ..] => python::bench(arguments),
        ["modules"] => modules::check(),
        ["wasm"] => wasm::build(),
        ["properties"] => run(&[PROPERTIES], &[("PROPTEST_CASES", PROPERTY_CASES)]),
        ["properties", cases] => run(&[PROPERTIES], &[("PROPTEST_CASES", cases)]),
        ["live"] => run(&[LIVE], &[("ENDLESS_LIVE_STEPS", LIVE_STEPS)]),
        ["live", steps] => run(&[LIVE], &[("ENDLESS_LIVE_STEPS", steps)]),
        ["original"] => original::python().map(|python| println!("{}", python.display())),
        [] | ["help" | "--help" | "-h"] => {
            println!("{HELP}");
            Ok(())
        }
        _ => Err(format!("unknown task `{}`; the tasks are\n{HELP}", arguments.join(" "))),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("xtask: {message}");
            ExitCode::FAILURE
        }
    }
}

/// Runs the tests that need a mount namespace of their own or the rights of root where the system permits them, and otherwise says
/// that they were not run.
fn mount_namespaces() -> Result<(), String> {
    const IN_NAMESPACES: [(&str, &str); 4] = [
        ("service", "too_little_shared_memory_is_an_error_and_not_a_signal"),
        ("service_faults", "inside_full_shared_memory_an_engine_reports_it_and_leaves_nothing"),
        ("service_faults", "inside_small_shared_memory_observers_get_what_is_left"),
        ("service_faults", "two_directories_of_one_path_share_nothing"),
    ];
    const AS_ROOT: [(&str, &str); 1] = [("service_faults", "as_root_a_segment_of_another_user_is_reported_or_avoided")];
    let mut probe = Command::new("unshare");
    probe.args(["--mount", "--map-root-user", "mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]).stderr(Stdio::null());
    let permitted = probe.status().is_ok_and(|status| status.success());
    let user = Command::new("id").arg("-u").output().map_err(|error| format!("`id -u`: {error}"))?;
    let is_root = user.stdout.trim_ascii() == b"0";
    for (permitted, reason, tests) in [
        (permitted, "this system refuses mount namespaces", &IN_NAMESPACES[..]),
        (is_root, "this user is not root", &AS_ROOT[..]),
    ] {
        for (program, name) in tests {
            if permitted {
                run(&[&["test", "--locked", "--test", program, "--", "--ignored", "--exact", name]], &[])?;
            } else {
                println!("==> not run: {name}, since {reason}");
            }
        }
    }
    Ok(())
}

/// Runs cargo with each of the argument lists. `ENDLESS_ORIGINAL_PYTHON` names a Python with the original environments.
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
