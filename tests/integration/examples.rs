//! The programs of `engine/examples` run and print what they promise.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::Once;

use endless_gym::service::Namespace;
use rustix::process::{Pid, Signal, kill_process};

/// A namespace of one test: engines of other tests and users are not visible in it.
struct Root(PathBuf);

impl Root {
    fn new(name: &str) -> Self {
        // The path of a root is short, that of the directory for temporary files may not be.
        Root(PathBuf::from(format!("/tmp/eg-{name}-{}", std::process::id())))
    }

    fn command(&self, program: &Path) -> Command {
        let mut command = Command::new(program);
        command.env("ENDLESS_GYM_ROOT", &self.0).stdin(Stdio::null());
        command
    }

    /// Runs an example to its end and returns what it printed.
    fn run(&self, name: &str, arguments: &[&str]) -> String {
        printed(name, self.command(&example(name)).args(arguments).output().unwrap())
    }
}

/// Removes what a failed test leaves behind: an engine that is killed cannot remove its segments.
impl Drop for Root {
    fn drop(&mut self) {
        let prefix = Namespace::at(&self.0).prefix().to_owned();
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&prefix) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A process that is killed with the test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
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

fn printed(name: &str, output: Output) -> String {
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{name}: {}\n{errors}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn environments_in_process() {
    let printed = Root::new("in-process").run("in_process", &["MortarMayhem-Grid-v0", "64"]);
    assert!(printed.contains("steps per second") && printed.contains("mean return"), "{printed}");
}

#[test]
fn a_search_over_snapshots_reaches_the_goal() {
    let printed = Root::new("tree-search").run("tree_search", &["1"]);
    assert!(printed.contains("the episode ended"), "{printed}");
}

#[test]
fn two_groups_in_flight() {
    let printed = Root::new("two-groups").run("two_groups", &[]);
    assert!(printed.contains("the engine sent 1002 batches"), "{printed}");
}

#[test]
fn a_trainer_and_an_observer_beside_an_engine() {
    let root = Root::new("trainer");
    let serve = ["serve", "--env", "MysteryPath-v0", "--num-envs", "8", "--service", "example"];
    let mut endless = root.command(Path::new(env!("CARGO_BIN_EXE_endless")));
    let mut engine = endless.args(serve).stdout(Stdio::null()).spawn().map(Running).unwrap();
    let mut observer = root.command(&example("observer")).arg("example").stdout(Stdio::piped()).spawn().unwrap();
    let mut observed = BufReader::new(observer.stdout.take().unwrap()).lines().map(Result::unwrap);
    assert_eq!(observed.next().unwrap(), "watching example");
    let printed_by_trainer = root.run("trainer", &["example"]);
    assert!(printed_by_trainer.contains("1000 steps of 8 environments"), "{printed_by_trainer}");
    kill_process(Pid::from_child(&engine.0), Signal::INT).unwrap();
    assert!(engine.0.wait().unwrap().success());
    assert_eq!(observed.last().unwrap(), "the engine has ended");
    assert!(observer.wait().unwrap().success());
}
