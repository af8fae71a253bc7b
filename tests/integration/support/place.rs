//! A separate namespace for a test, and the processes that use it.

use std::fs::{self, DirBuilder, Permissions};
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use endless_gym::service::{ConnectConfig, Namespace, ROOT_VARIABLE, ServiceError, Trainer, running_engines};
use serde_json::Value as Json;

use super::process::{Process, TIMEOUT, text, wait_until};

/// A namespace. Its directory and its segments are removed at the end of the test.
pub struct Place {
    namespace: Namespace,
}

impl Place {
    pub fn new() -> Self {
        // A random name, since a test run in another container may have the same process ids.
        let namespace = Namespace::at(format!("/tmp/endless-{:016x}", rand::random::<u64>()));
        DirBuilder::new().mode(0o700).create(namespace.root()).unwrap();
        Place { namespace }
    }

    pub fn namespace(&self) -> &Namespace {
        &self.namespace
    }

    pub fn root(&self) -> &Path {
        self.namespace.root()
    }

    /// A command that uses the namespace.
    pub fn command(&self, program: impl AsRef<Path>) -> Command {
        let mut command = Command::new(program.as_ref());
        command.env(ROOT_VARIABLE, self.root()).stdin(Stdio::null());
        command
    }

    /// The program `endless`.
    pub fn endless(&self, arguments: &[&str]) -> Command {
        let mut command = self.command(env!("CARGO_BIN_EXE_endless"));
        command.args(arguments);
        command
    }

    /// Runs `endless` to its end.
    pub fn run(&self, arguments: &[&str]) -> Output {
        self.endless(arguments).output().unwrap()
    }

    /// Starts `endless serve` with one thread, and waits until its engine can be found.
    pub fn serve(&self, arguments: &[&str]) -> Process {
        let mut command = self.endless(&[&["serve", "--threads", "1"], arguments].concat());
        let engine = Process::spawn(command.stdout(Stdio::null()));
        self.wait_for_engine();
        engine
    }

    pub fn wait_for_engine(&self) {
        wait_until("an engine runs", || !running_engines(&self.namespace).unwrap().is_empty());
    }

    /// What `endless status` prints about an engine.
    pub fn status(&self, service: &str) -> Json {
        let output = self.run(&["status", service, "--json"]);
        assert!(output.status.success(), "{}", text(&output.stderr));
        serde_json::from_slice::<Json>(&output.stdout).unwrap()[0].take()
    }

    /// Writes an executable script.
    pub fn script(&self, name: &str, script: &str) -> PathBuf {
        let path = self.root().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, format!("#!/bin/sh\n{script}\n")).unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o700)).unwrap();
        path
    }

    pub fn connect_config(&self, service: &str) -> ConnectConfig {
        ConnectConfig::new(service).namespace(self.namespace.clone()).timeout(TIMEOUT)
    }

    /// Connects to an engine; waits for it to start.
    pub fn trainer(&self, service: &str) -> Result<Trainer, ServiceError> {
        Trainer::connect(&self.connect_config(service))
    }

    /// Connects to an engine that must be running.
    pub fn trainer_now(&self, service: &str) -> Result<Trainer, ServiceError> {
        Trainer::connect(&ConnectConfig::new(service).namespace(self.namespace.clone()))
    }

    /// The shared memory segments.
    pub fn segments(&self) -> Vec<PathBuf> {
        let entries = fs::read_dir("/dev/shm").unwrap().map(|entry| entry.unwrap().path());
        let is_own = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().starts_with(self.namespace.prefix());
        entries.filter(is_own).collect()
    }

    /// The files in the directory and the shared memory segments, sorted.
    pub fn leftovers(&self) -> Vec<PathBuf> {
        let mut found = self.segments();
        files(self.root(), &mut found);
        found.sort();
        found
    }

    #[track_caller]
    pub fn assert_nothing_left(&self) {
        assert_eq!(self.leftovers(), [] as [PathBuf; 0]);
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        // Killed processes leave their segments.
        self.segments().iter().for_each(|segment| drop(fs::remove_file(segment)));
        let _ = fs::remove_dir_all(self.root());
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
