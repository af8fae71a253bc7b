//! The processes of a round, and what they report.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::event::Event;

/// Maximum number of bytes kept of a process's standard error.
const KEPT: usize = 4000;

/// How long to wait for the rest of a process's standard error.
const REMAINDER: Duration = Duration::from_secs(2);

/// A process of a round. It is killed when this is dropped.
pub struct Actor {
    child: Child,
    stdin: Option<ChildStdin>,
    stderr: Arc<Mutex<String>>,
    /// Reads standard error to its end.
    reader: Option<JoinHandle<()>>,
}

impl Actor {
    /// Starts a process. Its reports go to `events`, with its process id.
    pub fn start(mut command: Command, events: &Sender<(u32, Event)>) -> Result<Self, String> {
        let piped = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = piped.spawn().map_err(|error| format!("{command:?}: {error}"))?;
        let (id, events) = (child.id(), events.clone());
        if let Some(stdout) = child.stdout.take() {
            std::thread::spawn(move || {
                let lines = BufReader::new(stdout).lines().map_while(Result::ok);
                // A killed process may leave a partial line.
                for event in lines.filter_map(|line| serde_json::from_str(&line).ok()) {
                    if events.send((id, event)).is_err() {
                        break;
                    }
                }
            });
        }
        let stderr = Arc::new(Mutex::new(String::new()));
        let reader = child.stderr.take().map(|mut pipe| {
            let kept = Arc::clone(&stderr);
            std::thread::spawn(move || {
                let mut bytes = [0; 1024];
                while let Ok(count @ 1..) = pipe.read(&mut bytes) {
                    let Ok(mut kept) = kept.lock() else { break };
                    if kept.len() < KEPT {
                        kept.push_str(&String::from_utf8_lossy(&bytes[..count]));
                    }
                }
            })
        });
        let stdin = child.stdin.take();
        Ok(Actor { child, stdin, stderr, reader })
    }

    /// The process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal.
    pub fn signal(&self, signal: Signal) {
        self::signal(self.id(), signal);
    }

    /// Kills the process without letting it clean up.
    pub fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Asks it to end.
    pub fn close_input(&mut self) {
        drop(self.stdin.take());
    }

    /// Sends a line to its standard input.
    pub fn order(&mut self, line: &str) {
        if let Some(stdin) = &mut self.stdin {
            let _ = writeln!(stdin, "{line}");
        }
    }

    /// Its exit status, if it has ended.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().ok().flatten()
    }

    /// Waits for its end.
    pub fn wait(&mut self, limit: Duration) -> Option<ExitStatus> {
        let start = Instant::now();
        loop {
            let ended = self.ended();
            if ended.is_some() || start.elapsed() >= limit {
                return ended;
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// What it wrote to standard error before it ended, in one line.
    pub fn complaint(&self) -> String {
        // A process that it forked may keep the pipe open.
        let start = Instant::now();
        while self.reader.as_ref().is_some_and(|reader| !reader.is_finished()) && start.elapsed() < REMAINDER {
            std::thread::sleep(Duration::from_millis(1));
        }
        let text = self.stderr.lock().map(|text| text.clone()).unwrap_or_default();
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    }
}

impl Drop for Actor {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Sends a signal to a process, which may have ended.
pub fn signal(process: u32, signal: Signal) {
    if let Some(process) = i32::try_from(process).ok().and_then(Pid::from_raw) {
        let _ = kill_process(process, signal);
    }
}

/// Whether a process that this run did not kill crashed: it ended by a signal or a panic.
pub fn is_crash(status: ExitStatus) -> bool {
    status.signal().is_some() || status.code() == Some(101)
}

/// This program.
pub fn own_program() -> Result<PathBuf, String> {
    std::env::current_exe().map_err(|error| format!("own program: {error}"))
}

/// The program `endless`, built into the same folder.
pub fn engine_program() -> Result<PathBuf, String> {
    let program = own_program()?.with_file_name("endless");
    let missing = || format!("{} is missing; build it, or run `cargo xtask faults`", program.display());
    program.is_file().then(|| program.clone()).ok_or_else(missing)
}

/// This program in a role, with a JSON argument.
pub fn role(name: &str, argument: &impl serde::Serialize) -> Result<Command, String> {
    let mut command = Command::new(own_program()?);
    command.args(["role", name]).arg(serde_json::to_string(argument).map_err(|error| error.to_string())?);
    Ok(command)
}

/// Appends the command to the arguments of another one.
fn within(arguments: &[&str], command: &Command) -> Command {
    let mut outer = Command::new(arguments[0]);
    outer.args(&arguments[1..]).arg(command.get_program()).args(command.get_args());
    outer
}

/// The command with a limit on its descriptors.
pub fn with_descriptors(command: &Command, limit: u64) -> Command {
    within(&["sh", "-c", &format!("ulimit -n {limit}; exec \"$0\" \"$@\"")], command)
}

/// The command in a new mount namespace, after the shell command `mount`.
fn with_mount(command: &Command, mount: &str) -> Command {
    let script = format!("{mount} && exec \"$0\" \"$@\"");
    within(&["unshare", "--mount", "--map-root-user", "sh", "-c", &script], command)
}

/// The command with a new, empty directory mounted over the namespace's.
pub fn with_own_root(command: &Command) -> Command {
    with_mount(command, "mount -t tmpfs -o mode=700 tmpfs \"$ENDLESS_GYM_ROOT\"")
}

/// The command with a separate /dev/shm of that size.
pub fn with_own_memory(command: &Command, megabytes: u64) -> Command {
    with_mount(command, &format!("mount -t tmpfs -o size={megabytes}M tmpfs /dev/shm"))
}

/// The command run as the user nobody.
pub fn as_nobody(command: &Command) -> Command {
    within(&["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"], command)
}
