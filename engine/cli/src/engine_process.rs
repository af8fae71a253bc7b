//! An engine in a child process.

use std::ffi::OsString;
use std::io::Read;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use endless_gym_service::{ConnectConfig, ServiceError, Trainer};

use super::Failure;

/// Longest time that an engine may take to start.
const START_TIMEOUT: Duration = Duration::from_secs(30);

/// Longest wait for the engine between two checks that its process is alive.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// The command that starts `endless`, with its first arguments.
static EXECUTABLE: OnceLock<Vec<OsString>> = OnceLock::new();

/// Sets the command that starts `endless`. Only the first call has an effect.
pub fn set_executable(command: &[OsString]) {
    EXECUTABLE.get_or_init(|| command.to_vec());
}

/// A child process that serves environments. It ends when this value is dropped, and when this process dies.
pub struct EngineProcess {
    child: Child,
    service: String,
}

impl EngineProcess {
    /// Starts `endless serve` with these arguments. The engine's name contains the id of this process.
    pub fn start(arguments: &[String]) -> Result<Self, Failure> {
        let service = format!("endless-{}", std::process::id());
        let (program, first) = EXECUTABLE
            .get()
            .and_then(|command| command.split_first())
            .ok_or("the command that starts an engine is empty")?;
        let child = Command::new(program)
            .args(first)
            .args(["serve", "--child", "--service", &service])
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // In a process group of its own, the engine does not receive Ctrl-C. This process does, and then stops the engine.
            .process_group(0)
            .spawn()?;
        Ok(EngineProcess { child, service })
    }

    /// Connects as the engine's trainer, and waits for the engine to start.
    pub fn connect(&mut self) -> Result<Trainer, Failure> {
        let start = Instant::now();
        loop {
            let config = ConnectConfig { timeout: POLL_INTERVAL, ..ConnectConfig::new(&self.service) };
            match Trainer::connect(&config) {
                Err(ServiceError::UnknownEngine { .. }) if start.elapsed() < START_TIMEOUT => {}
                connected => return Ok(connected?),
            }
            if let Some(status) = self.child.try_wait()? {
                let mut message = String::new();
                if let Some(stderr) = &mut self.child.stderr {
                    stderr.read_to_string(&mut message)?;
                }
                let message = message.trim().trim_start_matches("endless: ");
                return Err(if message.is_empty() {
                    format!("the engine ended: {status}")
                } else {
                    message.to_owned()
                }
                .into());
            }
        }
    }
}

impl Drop for EngineProcess {
    fn drop(&mut self) {
        drop(self.child.stdin.take());
        let _ = self.child.wait();
    }
}
