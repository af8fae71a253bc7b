//! Child processes of tests, and waiting for them.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcsetwinsize};

/// How long a call of the service may take.
pub const TIMEOUT: Duration = Duration::from_secs(10);

/// How long a process may take for anything; the machine may be busy with other tests.
const PATIENCE: Duration = Duration::from_secs(60);

/// Waits until a condition holds.
#[track_caller]
pub fn wait_until(what: &str, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < PATIENCE, "{what}: not within {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

pub fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

/// A child process. It is killed when this is dropped.
pub struct Process(pub Child);

impl Process {
    pub fn spawn(command: &mut Command) -> Self {
        Process(command.spawn().unwrap())
    }

    pub fn id(&self) -> u32 {
        self.0.id()
    }

    pub fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.0), signal).unwrap();
    }

    /// Stops the process, and waits until it is stopped.
    pub fn stop(&self) {
        self.signal(Signal::STOP);
        wait_until("the process is stopped", || {
            let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.id())).unwrap();
            stat.rsplit(") ").next().unwrap().starts_with('T')
        });
    }

    pub fn resume(&self) {
        self.signal(Signal::CONT);
    }

    /// Kills the process without letting it clean up.
    pub fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }

    /// Waits for the end of the process.
    pub fn wait(&mut self) -> ExitStatus {
        wait_until("the process ends", || self.0.try_wait().unwrap().is_some());
        self.0.wait().unwrap()
    }

    /// Ends the process as Ctrl-C does.
    #[track_caller]
    pub fn interrupt(&mut self) {
        self.signal(Signal::INT);
        assert!(self.wait().success());
    }

    /// Ends a process that runs until its standard input is closed.
    #[track_caller]
    pub fn end(mut self) {
        drop(self.0.stdin.take());
        assert!(self.wait().success());
    }

    /// What the process writes to standard output from now on.
    pub fn output(&mut self) -> String {
        read(self.0.stdout.take())
    }

    /// What the process writes to standard error from now on.
    pub fn errors(&mut self) -> String {
        read(self.0.stderr.take())
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn read(pipe: Option<impl Read>) -> String {
    let mut text = String::new();
    pipe.unwrap().read_to_string(&mut text).unwrap();
    text
}

/// A program that answers each line of JSON with another.
pub struct Answering {
    _process: Process,
    requests: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Answering {
    /// Starts a script in the Python that the environment variable names.
    pub fn start(variable: &str, script: &Path, arguments: &[&str]) -> Self {
        let python =
            std::env::var(variable).unwrap_or_else(|_| panic!("run `cargo xtask test --all`, or set {variable}"));
        let mut command = Command::new(python);
        command.arg(script).args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut process = Process::spawn(&mut command);
        let (requests, answers) = (process.0.stdin.take().unwrap(), process.0.stdout.take().unwrap());
        Answering { _process: process, requests, answers: BufReader::new(answers) }
    }

    pub fn ask<T: serde::de::DeserializeOwned>(&mut self, request: &serde_json::Value) -> T {
        writeln!(self.requests, "{request}").unwrap();
        let mut line = String::new();
        self.answers.read_line(&mut line).unwrap();
        serde_json::from_str(&line).unwrap_or_else(|error| panic!("{request}: the answer is `{line:.300}`: {error}"))
    }
}

/// Both ends of a pseudo-terminal: the terminal emulator's, and that of the program in it.
pub fn pseudo_terminal(columns: u16, rows: u16) -> (File, File) {
    // A program that inherited the emulator's end would keep it open.
    let emulator = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
    grantpt(&emulator).unwrap();
    unlockpt(&emulator).unwrap();
    tcsetwinsize(&emulator, Winsize { ws_row: rows, ws_col: columns, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
    let name = ptsname(&emulator, Vec::new()).unwrap().into_string().unwrap();
    (emulator.into(), File::options().read(true).write(true).open(name).unwrap())
}

/// Marks the process in which [`again`] runs a test.
const AGAIN: &str = "ENDLESS_TEST_AGAIN";

/// Runs the test `name` of this program in a separate process, where it returns true, and fails if the test does.
#[track_caller]
pub fn alone(name: &str) -> bool {
    again(Command::new(std::env::current_exe().unwrap()), name)
}

/// Like [`alone`], in a new mount namespace, after the shell commands `mounts`.
#[track_caller]
pub fn inside_namespace(name: &str, mounts: &str) -> bool {
    let mut command = unshare(mounts);
    command.arg(std::env::current_exe().unwrap());
    again(command, name)
}

/// A command that runs its further arguments in a new mount namespace, after the shell commands `mounts`.
pub fn unshare(mounts: &str) -> Command {
    let mut command = Command::new("unshare");
    command.args(["--mount", "--map-root-user", "sh", "-c", &format!("{mounts} && exec \"$0\" \"$@\"")]);
    command.stdin(Stdio::null());
    command
}

#[track_caller]
fn again(mut test: Command, name: &str) -> bool {
    if std::env::var_os(AGAIN).is_some() {
        return true;
    }
    let output = test.args([name, "--exact", "--include-ignored", "--nocapture"]).env(AGAIN, "1").output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && text.contains("1 passed"), "{}: {text}", output.status);
    false
}
