//! The programs of `engine/examples` run and print what they promise.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Once;

use crate::support::place::Place;
use crate::support::process::{Process, text};

/// Runs an example to its end and returns what it printed.
fn run(place: &Place, name: &str, arguments: &[&str]) -> String {
    let output = place.command(example(name)).args(arguments).output().unwrap();
    assert!(output.status.success(), "{name}: {}\n{}", output.status, text(&output.stderr));
    text(&output.stdout).to_owned()
}

/// The program of an example. Cargo builds all of them for `cargo test`, but none for `cargo test --test integration`. `cargo xtask test`
/// sets the variable, so that the test does not wait for what cargo compiles beside it.
fn example(name: &str) -> PathBuf {
    static BUILT: Once = Once::new();
    BUILT.call_once(|| {
        if std::env::var_os("ENDLESS_EXAMPLES_BUILT").is_some() {
            return;
        }
        let mut build = Command::new(env!("CARGO"));
        build.args(["build", "--quiet", "--locked", "--examples"]).current_dir(env!("CARGO_MANIFEST_DIR"));
        if !cfg!(debug_assertions) {
            build.arg("--release");
        }
        assert!(build.status().unwrap().success());
    });
    let test = std::env::current_exe().unwrap();
    test.parent().and_then(Path::parent).unwrap().join("examples").join(name)
}

#[test]
fn environments_in_process() {
    let printed = run(&Place::new(), "in_process", &["MortarMayhem-Grid-v0", "64"]);
    assert!(printed.contains("steps per second") && printed.contains("mean return"), "{printed}");
}

#[test]
fn a_search_over_snapshots_reaches_the_goal() {
    let printed = run(&Place::new(), "tree_search", &["1"]);
    assert!(printed.contains("the episode ended"), "{printed}");
}

#[test]
fn two_groups_in_flight() {
    let printed = run(&Place::new(), "two_groups", &[]);
    assert!(printed.contains("the engine sent 1002 batches"), "{printed}");
}

#[test]
fn a_trainer_and_an_observer_beside_an_engine() {
    let place = Place::new();
    let mut engine = place.serve(&["--env", "MysteryPath-v0", "--num-envs", "8", "--service", "example"]);
    let mut observer = place.command(example("observer"));
    let mut observer = Process::spawn(observer.arg("example").stdout(Stdio::piped()));
    let mut observed = BufReader::new(observer.0.stdout.take().unwrap()).lines().map(Result::unwrap);
    assert_eq!(observed.next().unwrap(), "watching example");
    let printed = run(&place, "trainer", &["example"]);
    assert!(printed.contains("1000 steps of 8 environments"), "{printed}");
    engine.interrupt();
    assert_eq!(observed.last().unwrap(), "the engine has ended");
    assert!(observer.wait().success());
}
