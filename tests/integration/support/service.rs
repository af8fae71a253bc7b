//! Processes for the tests of the service.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use endless_gym::pool::{PoolConfig, ResetRequest};
use endless_gym::service::{ConnectConfig, Engine, EngineConfig, Namespace, ServiceError, Trainer};

pub const ID: &str = "MortarMayhem-Grid-v0";
const ROLE: &str = "ENDLESS_TEST_ROLE";

/// Arguments with which a test program runs its ignored test `role`, and no other.
pub const ROLE_ARGUMENTS: [&str; 4] = ["role", "--exact", "--ignored", "--nocapture"];

/// A namespace for one test. It is removed at the end of the test.
pub struct Place {
    namespace: Namespace,
}

impl Place {
    pub fn new() -> Self {
        // At random, since another test run may have the same process ids in a container of its own.
        Place { namespace: Namespace::at(format!("/tmp/endless-{:016x}", rand::random::<u64>())) }
    }

    pub fn namespace(&self) -> &Namespace {
        &self.namespace
    }

    /// Starts an engine in a child process.
    pub fn engine(&self, service: &str, num_envs: usize, groups: usize) -> Running {
        self.role("engine", service, &[&num_envs.to_string(), &groups.to_string()])
    }

    /// Connects to an engine; waits for it to start.
    pub fn trainer(&self, service: &str) -> Result<Trainer, ServiceError> {
        Trainer::connect(&self.connect_config(service))
    }

    /// Connects to an engine that must be running.
    pub fn trainer_now(&self, service: &str) -> Result<Trainer, ServiceError> {
        Trainer::connect(&ConnectConfig { timeout: Duration::ZERO, ..self.connect_config(service) })
    }

    pub fn connect_config(&self, service: &str) -> ConnectConfig {
        let timeout = Duration::from_secs(10);
        ConnectConfig { service: service.to_owned(), namespace: self.namespace.clone(), timeout }
    }

    /// Starts this test program in another role.
    pub fn role(&self, role: &str, service: &str, arguments: &[&str]) -> Running {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(ROLE_ARGUMENTS)
            .envs(self.role_environment(role, service, arguments))
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        let stdin = child.stdin.take();
        Running { child, stdin }
    }

    pub fn role_environment(&self, role: &str, service: &str, arguments: &[&str]) -> [(&'static str, String); 2] {
        let value = [&[role, service], arguments].concat().join(" ");
        [(ROLE, value), ("ENDLESS_GYM_ROOT", self.namespace.root().display().to_string())]
    }

    /// The files in the namespace's directory, and its shared memory segments.
    pub fn leftovers(&self) -> Vec<PathBuf> {
        let mut found = Vec::new();
        files(self.namespace.root(), &mut found);
        found.extend(self.segments());
        found
    }

    fn segments(&self) -> impl Iterator<Item = PathBuf> {
        let ours = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().starts_with(self.namespace.prefix());
        let entries = fs::read_dir("/dev/shm").into_iter().flatten();
        entries.filter_map(|entry| entry.ok().map(|entry| entry.path())).filter(ours)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.segments().for_each(|segment| drop(fs::remove_file(segment)));
        let _ = fs::remove_dir_all(self.namespace.root());
    }
}

fn files(directory: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(directory).into_iter().flatten().flatten() {
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => files(&entry.path(), found),
            _ => found.push(entry.path()),
        }
    }
}

/// A child process of a test. It is killed when this is dropped.
pub struct Running {
    child: Child,
    stdin: Option<ChildStdin>,
}

impl Running {
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Kills the process, which cannot clean up.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Ends the process regularly.
    pub fn end(mut self) {
        drop(self.stdin.take());
        assert!(self.child.wait().unwrap().success());
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub fn engine_config(namespace: &Namespace, service: &str, num_envs: usize, groups: usize) -> EngineConfig {
    let pool = PoolConfig { check_drawing: true, ..PoolConfig::new(ID, num_envs) };
    let config = EngineConfig::new(service, pool, 1);
    EngineConfig { namespace: namespace.clone(), groups, ..config }
}

/// Runs in the role that the environment names; does nothing if there is none.
pub fn play_role() {
    let Ok(role) = std::env::var(ROLE) else { return };
    let words: Vec<&str> = role.split(' ').collect();
    match words[..] {
        ["engine", service, num_envs, groups] => {
            let config =
                engine_config(&Namespace::default(), service, num_envs.parse().unwrap(), groups.parse().unwrap());
            let mut engine = Engine::new(&config).unwrap_or_else(|e| panic!("{e}: {e:?}"));
            engine.run(&stop_at_end_of_input()).unwrap();
        }
        ["trainer", service] => {
            let timeout = Duration::from_secs(10);
            let mut trainer = Trainer::connect(&ConnectConfig { timeout, ..ConnectConfig::new(service) }).unwrap();
            let groups = trainer.specification().groups;
            for group in 0..groups {
                trainer.reset(group, ResetRequest::All).unwrap();
            }
            loop {
                let group = trainer.receive_any(timeout).unwrap().group();
                trainer.send_with(group, |actions| actions.fill(0)).unwrap();
            }
        }
        ["sender", service] => {
            let timeout = Duration::from_secs(10);
            let mut trainer = Trainer::connect(&ConnectConfig { timeout, ..ConnectConfig::new(service) }).unwrap();
            trainer.reset(0, ResetRequest::All).unwrap();
            loop {
                // An engine that is stopped answers when it is killed or continued.
                match trainer.receive(0, timeout) {
                    Err(ServiceError::TimedOut { .. }) => {}
                    received => {
                        received.unwrap();
                        trainer.send_with(0, |actions| actions.fill(0)).unwrap();
                    }
                }
            }
        }
        _ => panic!("unknown role {role}"),
    }
}

/// A flag that is set when the parent process closes standard input.
fn stop_at_end_of_input() -> Arc<AtomicBool> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    std::thread::spawn(move || {
        let _ = std::io::stdin().read_to_end(&mut Vec::new());
        flag.store(true, Ordering::Relaxed);
    });
    stop
}
