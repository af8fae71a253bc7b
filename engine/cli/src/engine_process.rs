//! An engine in a child process.

use std::ffi::OsString;
use std::io::{self, Read, Write};
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use endless_gym_service::{ConnectConfig, EngineConfig, ErrorKind, Namespace, ROOT_VARIABLE, Trainer};

use crate::failure::Failure;

/// Longest time that an engine may take to start.
const START_TIMEOUT: Duration = Duration::from_secs(30);

/// Longest time that an engine may take to end before it is killed.
const END_TIMEOUT: Duration = Duration::from_secs(10);

/// Longest wait for the engine between checks of the stop flag and of the engine's process.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// Maximum length of an engine's message in bytes; the rest of its standard error is discarded.
const MESSAGE_BYTES: u64 = 64 * 1024;

/// The command that starts `endless`, with its first arguments.
static EXECUTABLE: OnceLock<Vec<OsString>> = OnceLock::new();

/// Sets the command that starts `endless`. Only the first call has an effect.
pub fn set_executable(command: &[OsString]) {
    EXECUTABLE.get_or_init(|| command.to_vec());
}

/// Ends this process, whose threads cannot be stopped, and removes the files of its engine. Another program takes its place: a process
/// cannot remove the resources of threads that still use them.
pub fn replace_by_cleanup(namespace: &Namespace) {
    if let Some((program, first)) = EXECUTABLE.get().and_then(|command| command.split_first()) {
        let mut command = Command::new(program);
        command.args(first).arg("clean").env(ROOT_VARIABLE, namespace.root());
        // It returns only if it fails; the next engine removes the files then.
        let _ = command.stdin(Stdio::null()).exec();
    }
    std::process::exit(1)
}

/// A child process that serves environments. It ends when this value is dropped, and when this process dies.
pub struct EngineProcess {
    child: Child,
    /// Reads the child's standard error until it is closed.
    stderr: Option<JoinHandle<Vec<u8>>>,
    config: ConnectConfig,
}

impl EngineProcess {
    /// Starts `endless serve` with this configuration. The engine's name contains the id of this process.
    pub fn start(config: EngineConfig) -> Result<Self, Failure> {
        let service = format!("endless-{}", std::process::id());
        let (program, first) = EXECUTABLE
            .get()
            .and_then(|command| command.split_first())
            .ok_or("the command that starts an engine is empty")?;
        let mut command = Command::new(program);
        let child = format!("--child={}", std::process::id());
        command.args(first).args(["serve", &child, "--config", "-"]);
        let mut engine = Self::spawn(command, ConnectConfig::new(&service))?;
        if let Some(stdin) = &mut engine.child.stdin {
            // On an error the engine has ended, which `connect` reports with the engine's message.
            let _ = serde_json::to_writer(stdin, &config.service(service));
        }
        Ok(engine)
    }

    fn spawn(mut command: Command, config: ConnectConfig) -> Result<Self, Failure> {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // A separate process group, so that Ctrl-C reaches only this process, which then stops the engine.
            .process_group(0)
            .spawn()?;
        // In a thread, because a child blocks when the pipe is full.
        let reads = |stderr| thread::Builder::new().name("stderr".to_owned()).spawn(|| read_message(stderr));
        let stderr = child.stderr.take().map(reads).transpose();
        let stderr = stderr.inspect_err(|_| {
            let _ = child.kill().and_then(|()| child.wait());
        })?;
        let config = config.timeout(POLL_INTERVAL);
        Ok(EngineProcess { child, stderr, config })
    }

    /// The engine's name.
    pub fn service(&self) -> &str {
        &self.config.service
    }

    /// Its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Connects as the engine's trainer, and waits for the engine to start. Setting `stop` ends the wait with an error.
    pub fn connect(&mut self, stop: &AtomicBool) -> Result<Trainer, Failure> {
        self.connect_within(START_TIMEOUT, stop)
    }

    fn connect_within(&mut self, timeout: Duration, stop: &AtomicBool) -> Result<Trainer, Failure> {
        let start = Instant::now();
        loop {
            match Trainer::connect(&self.config) {
                Err(error) if error.kind() == ErrorKind::Unavailable => {}
                connected => return Ok(connected?),
            }
            if let Some(status) = self.child.try_wait()? {
                let message = self.stderr.take().and_then(|reader| reader.join().ok()).unwrap_or_default();
                let message = String::from_utf8_lossy(&message);
                // Logs may come before the message.
                let message = message.rsplit_once("\nendless: ").map_or(&*message, |(_, message)| message);
                let message = message.trim().trim_start_matches("endless: ");
                return Err(if message.is_empty() {
                    format!("the engine ended: {status}")
                } else {
                    message.to_owned()
                }
                .into());
            }
            if stop.load(Ordering::Relaxed) {
                return Err("stopped before the engine was ready".into());
            }
            if start.elapsed() >= timeout {
                return Err(format!("the engine did not start within {} s", timeout.as_secs()).into());
            }
        }
    }
}

impl Drop for EngineProcess {
    fn drop(&mut self) {
        if let Some(mut stdin) = self.child.stdin.take() {
            // Closing it is not enough if another process has inherited it. On an error the engine has ended.
            let _ = stdin.write_all(b"\n");
        }
        let start = Instant::now();
        while let Ok(None) = self.child.try_wait() {
            if start.elapsed() >= END_TIMEOUT {
                let _ = self.child.kill();
                let _ = self.child.wait();
                return;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// Reads standard error to its end and returns the beginning.
fn read_message(mut stderr: ChildStderr) -> Vec<u8> {
    let mut message = Vec::new();
    // An error ends the message.
    let _ = stderr.by_ref().take(MESSAGE_BYTES).read_to_end(&mut message);
    let _ = io::copy(&mut stderr, &mut io::sink());
    message
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The error of connecting to a shell script instead of an engine.
    fn error(name: &str, script: &str, timeout: Duration, stop: bool) -> String {
        let root = format!("/tmp/endless-child-{name}-{}", std::process::id());
        let config = ConnectConfig::new("gym").namespace(Namespace::at(&root));
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        let mut engine = EngineProcess::spawn(command, config).unwrap();
        let error = engine.connect_within(timeout, &AtomicBool::new(stop)).map(drop).unwrap_err().to_string();
        drop(engine);
        std::fs::remove_dir_all(root).unwrap();
        error
    }

    #[test]
    fn a_long_message_does_not_block_the_engine() {
        let script = "echo endless: no memory >&2; head -c 300000 /dev/zero >&2; exit 1";
        let message = error("message", script, START_TIMEOUT, false);
        assert!(message.starts_with("no memory\n"), "{}", &message[..40.min(message.len())]);
        assert!(message.len() <= MESSAGE_BYTES as usize);
        assert_eq!(error("silent", "exit 3", START_TIMEOUT, false), "the engine ended: exit status: 3");
    }

    #[test]
    fn waiting_for_an_engine_ends_with_the_stop_flag_or_the_timeout() {
        assert_eq!(error("stop", "cat", START_TIMEOUT, true), "stopped before the engine was ready");
        assert_eq!(error("slow", "cat", Duration::ZERO, false), "the engine did not start within 0 s");
    }
}
