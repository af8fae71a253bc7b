//! Tests that the programs of `docs/examples` run and print what they should.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Once;

use endless_gym::envs::ActionSpace;
use endless_gym::pool::ResetRequest;

use crate::support::place::Place;
use crate::support::process::{Process, TIMEOUT, text};

/// Runs an example to its end and returns what it printed.
fn run(place: &Place, name: &str, arguments: &[&str]) -> String {
    let output = place.command(example(name)).args(arguments).output().unwrap();
    assert!(output.status.success(), "{name}: {}\n{}", output.status, text(&output.stderr));
    text(&output.stdout).to_owned()
}

/// The program of an example. Cargo builds examples for `cargo test`, but not for `cargo test --test integration`.
/// `cargo xtask test` sets the variable, so that this test does not wait for cargo's other compilations.
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
fn a_trainer_and_an_observer_connect_to_an_engine() {
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

#[test]
fn a_program_serves_an_environment_that_its_trainer_does_not_know() {
    let place = Place::new();
    let listed = run(&place, "t_maze", &["list", "TMaze-v0"]);
    assert!(listed.contains("Remember the cue") && listed.contains("max_steps"), "{listed}");
    let serve = ["serve", "--env", "TMaze-v0", "--num-envs", "4", "--features", "--service", "maze"];
    let mut engine = Process::spawn(place.command(example("t_maze")).args(serve).stdout(Stdio::null()));
    let mut trainer = place.trainer("maze").unwrap();
    assert_eq!(trainer.specification().action_space, ActionSpace::Discrete(3));
    trainer.reset(0, ResetRequest::Seed(1)).unwrap();
    let first = trainer.receive(0, TIMEOUT).unwrap();
    let cues: Vec<i32> = first.batch().features().chunks_exact(2).map(|row| (row[0] == 1.0).into()).collect();
    drop(first);
    for step in 0..=10 {
        let fill = |actions: &mut [i32]| if step < 10 { actions.fill(2) } else { actions.copy_from_slice(&cues) };
        trainer.send_with(0, fill).unwrap();
        let lease = trainer.receive(0, TIMEOUT).unwrap();
        assert_eq!(lease.batch().terminated(), [u8::from(step == 10); 4]);
        assert_eq!(lease.batch().reward(), [if step == 10 { 1.0 } else { -0.01 }; 4]);
    }
    drop(trainer);
    engine.interrupt();
}

#[test]
fn an_agent_learns_in_an_environment_that_its_program_does_not_know() {
    let place = Place::new();
    let run = place.root().join("run");
    let serve = "serve --env TMaze-v0 --num-envs 4 --groups 2 --features --no-frames --autoreset same-step --service maze \
                 --seed 1 --seed-range 0..100_000 --option length=2";
    let mut engine =
        Process::spawn(place.command(example("t_maze")).args(serve.split_whitespace()).stdout(Stdio::null()));
    place.trainer("maze").unwrap();
    let sizes = "--ppo.steps 16 --recurrence.sequence-length 8 --recurrence.hidden-size 8 --ppo.updates";
    let learn = |arguments: String| {
        let output = place.run(&std::iter::once("learn").chain(arguments.split_whitespace()).collect::<Vec<_>>());
        (output.status.code(), text(&output.stdout).to_owned() + text(&output.stderr))
    };
    let run = run.display();
    let (status, printed) = learn(format!("t_maze:TMaze-v0 --connect maze --run {run} {sizes} 2"));
    assert_eq!(status, Some(0), "{printed}");
    assert!(printed.contains(&format!("endless learn --resume {run} --connect maze --ppo.updates 4")), "{printed}");
    let (status, printed) = learn(format!("--resume {run} --connect maze --ppo.updates 4"));
    assert!(status == Some(0) && printed.contains("4 of 4 updates done"), "{printed}");
    // The same numbers as in a program that has the environment.
    let here = place.root().join("here");
    let arguments = format!(
        "learn TMaze-v0 --run {} --environment.num-envs 8 --environment.groups 2 --environment.option length=2 {sizes} 4",
        here.display()
    );
    let output = place.command(example("t_maze")).args(arguments.split_whitespace()).output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    let rows = |run: &dyn std::fmt::Display| {
        let text = std::fs::read_to_string(format!("{run}/progress.jsonl")).unwrap();
        let row = |line: &str| {
            let row: serde_json::Value = serde_json::from_str(line).unwrap();
            ["loss", "episode/success"].map(|name| row[name].clone())
        };
        text.lines().map(row).collect::<Vec<_>>()
    };
    assert_eq!(rows(&run), rows(&here.display()));
    assert!(rows(&run).len() == 4 && rows(&run)[3].iter().all(serde_json::Value::is_f64));
    for (arguments, message) in [
        (format!("--resume {run}"), "no environment `TMaze-v0`; ".to_owned()),
        (format!("--resume {run}"), "; for one that another program serves, add --connect SERVICE".to_owned()),
        (
            format!("MysteryPath-v0 --connect maze --run {run}2"),
            "must serve 2 groups of 4 environments MysteryPath-v0".to_owned(),
        ),
    ] {
        let (status, printed) = learn(arguments);
        assert!(status == Some(1) && printed.contains(&message), "{printed}");
    }
    engine.interrupt();
}
