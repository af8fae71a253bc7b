//! An engine in a process of its own.

use std::ffi::OsString;
use std::io::Read;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use endless_gym_service::{ConnectConfig, ServiceError, Trainer};

use super::Failure;

/// How long an engine may take to start.
const START: Duration = Duration::from_secs(30);

/// How often its start is looked for.
const LOOK: Duration = Duration::from_millis(100);

/// The command that starts `endless`, and its first arguments.
static PROGRAM: OnceLock<Vec<OsString>> = OnceLock::new();

/// Says which command starts `endless`. Only the first call counts.
pub fn set_program(program: &[OsString]) {
    PROGRAM.get_or_init(|| program.to_vec());
}

/// A child process that serves environments. It ends when this is dropped, and also when this process dies.
pub struct EngineProcess {
    child: Child,
    service: String,
}

impl EngineProcess {
    /// Starts `endless serve` with these arguments under a name of its own.
    pub fn start(arguments: &[String]) -> Result<Self, Failure> {
        let service = format!("endless-{}", std::process::id());
        let (program, first) = PROGRAM
            .get()
            .and_then(|program| program.split_first())
            .ok_or("the command that starts an engine is empty")?;
        let child = Command::new(program)
            .args(first)
            .args(["serve", "--child", "--service", &service])
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // A group of its own, so that Ctrl-C reaches this process alone, which then ends the engine.
            .process_group(0)
            .spawn()?;
        Ok(EngineProcess { child, service })
    }

    /// Connects as the engine's trainer.
    pub fn connect(&mut self) -> Result<Trainer, Failure> {
        let start = Instant::now();
        loop {
            let config = ConnectConfig { timeout: LOOK, ..ConnectConfig::new(&self.service) };
            match Trainer::connect(&config) {
                Err(ServiceError::UnknownEngine { .. }) if start.elapsed() < START => {}
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
