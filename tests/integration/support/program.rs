//! The `endless` program as a real process, and a place for it.

use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use endless_gym::service::{ConnectConfig, Namespace, Trainer};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value as Json;

/// A directory of sockets for one test alone, and what is left of its segments.
pub struct Room {
    pub root: PathBuf,
}

impl Room {
    pub fn new(name: &str) -> Self {
        // At random, since another test run may have the same process ids in a container of its own.
        let root = PathBuf::from(format!("/tmp/endless-{name}-{:016x}", rand::random::<u64>()));
        std::fs::create_dir_all(&root).unwrap();
        std::fs::set_permissions(&root, std::fs::Permissions::from_mode(0o700)).unwrap();
        Room { root }
    }

    pub fn endless(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_endless"));
        command.args(arguments).env("ENDLESS_GYM_ROOT", &self.root);
        command
    }

    pub fn run(&self, arguments: &[&str]) -> Output {
        self.endless(arguments).output().unwrap()
    }

    /// A program that is a script.
    pub fn program(&self, name: &str, script: &str) -> PathBuf {
        let path = self.root.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, format!("#!/bin/sh\n{script}\n")).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o700)).unwrap();
        path
    }

    pub fn segments(&self) -> Vec<String> {
        let prefix = Namespace::at(&self.root).prefix().to_owned();
        let names = std::fs::read_dir("/dev/shm").unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
        names.filter(|name| name.starts_with(&prefix)).collect()
    }

    pub fn wait_for_engine(&self) {
        let start = Instant::now();
        while endless_gym::service::running_engines(&Namespace::at(&self.root)).unwrap().is_empty() {
            assert!(start.elapsed() < Duration::from_secs(20), "no engine starts");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    pub fn config(&self, service: &str) -> ConnectConfig {
        let (namespace, timeout) = (Namespace::at(&self.root), Duration::from_secs(10));
        ConnectConfig { namespace, timeout, ..ConnectConfig::new(service) }
    }

    pub fn connect(&self, service: &str) -> Trainer {
        Trainer::connect(&self.config(service)).unwrap()
    }

    /// What `endless status` says about an engine.
    pub fn status(&self, service: &str) -> Json {
        let output = self.run(&["status", service, "--json"]);
        assert!(output.status.success(), "{}", text(&output.stderr));
        serde_json::from_slice::<Json>(&output.stdout).unwrap()[0].take()
    }

    /// The files of the directory and the segments, sorted.
    pub fn everything(&self) -> Vec<String> {
        let mut found = self.segments();
        let mut directories = vec![self.root.clone()];
        while let Some(directory) = directories.pop() {
            for path in std::fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path()) {
                found.push(path.display().to_string());
                if path.is_dir() {
                    directories.push(path);
                }
            }
        }
        found.sort();
        found
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        // Those of programs that were killed.
        for segment in self.segments() {
            let _ = std::fs::remove_file(std::path::Path::new("/dev/shm").join(segment));
        }
        let _ = std::fs::remove_dir_all(&self.root);
    }
}

pub fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

pub fn signal(child: &Child, signal: Signal) {
    kill_process(Pid::from_child(child), signal).unwrap();
}

pub fn wait(child: &mut Child) -> std::process::ExitStatus {
    let start = Instant::now();
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return status;
        }
        assert!(start.elapsed() < Duration::from_secs(20), "the program does not end");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// An engine process, `endless serve`. It is killed when this is dropped.
pub struct Engine(pub Child);

impl Engine {
    pub fn start(room: &Room, arguments: &[&str]) -> Self {
        let mut command = room.endless(&[&["serve", "--threads", "1"], arguments].concat());
        let engine = Engine(command.stdout(Stdio::null()).spawn().unwrap());
        room.wait_for_engine();
        engine
    }

    /// Ends it as Ctrl-C does.
    pub fn end(&mut self) {
        signal(&self.0, Signal::INT);
        wait(&mut self.0);
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
