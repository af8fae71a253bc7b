//! `cargo xtask test`.

use std::process::{Command, Stdio};

use crate::{cargo, instructions, modules, python, wasm};

/// Runs of cargo, in this order; the first failure ends the tests.
const CARGO: &[&[&str]] = &[
    &["fmt", "--all", "--check"],
    &["clippy", "--workspace", "--all-targets", "--locked", "--", "--deny", "warnings"],
    &["clippy", "--package", "endless-gym-core", "--no-default-features", "--locked", "--", "--deny", "warnings"],
    &["test", "--workspace", "--locked"],
    &["doc", "--workspace", "--no-deps", "--locked"],
];

/// A seed of the property tests: a failure in these tests is due to a change.
const PROPERTY_SEED: (&str, &str) = ("PROPTEST_RNG_SEED", "20251122");

pub fn run() -> Result<(), String> {
    for arguments in CARGO {
        cargo::run(arguments, &[PROPERTY_SEED])?;
    }
    mount_namespaces()?;
    modules::check()?;
    wasm::check()?;
    instructions::run(false)?;
    python::test()?;
    println!("all passed");
    Ok(())
}

/// Runs the test that needs a mount namespace of its own where the system permits it, and otherwise says that it was not run.
fn mount_namespaces() -> Result<(), String> {
    const NAME: &str = "too_little_shared_memory_is_an_error_and_not_a_signal";
    let mut probe = Command::new("unshare");
    probe.args(["--mount", "--map-root-user", "mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]).stderr(Stdio::null());
    if probe.status().is_ok_and(|status| status.success()) {
        return cargo::run(&["test", "--locked", "--test", "service", "--", "--ignored", "--exact", NAME], &[]);
    }
    println!("==> not run: {NAME}, since this system refuses mount namespaces");
    Ok(())
}
