//! The reports of a round's processes, one JSON object per line, and their common clock.

use std::io::Write;
use std::time::Duration;

use endless_gym_service::ServiceError;
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

/// A report of a trainer, an observer or a visitor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Event {
    /// An attempt to connect, to reconnect or to list engines begins.
    Connecting { at: Duration },
    /// A connection to a run of the engine.
    Connected { incarnation: u64, engine: u32 },
    /// A batch. A trainer has compared it with its twin's and reports whether it is correct.
    Batch { at: Duration, incarnation: u64, group: usize, step: u64, checksum: u32, is_correct: bool },
    /// Bytes differ from the twin's, or changed while the batch was held.
    Wrong { what: String },
    /// A step was lost or repeated.
    Miscounted { what: String },
    /// A guarantee of the interface was violated.
    Broken { what: String },
    /// A call failed.
    Error { during: String, kind: String, text: String, engine: Option<u32> },
    /// A page has shown this many messages of the engine.
    Shown { messages: u64 },
    /// A child process was forked.
    Forked { child: u32 },
    /// The process ended regularly.
    End,
}

impl Event {
    /// Reports an error.
    pub fn error(during: &str, error: &ServiceError, engine: Option<u32>) -> Self {
        let kind = format!("{error:?}");
        let kind = kind.split(|letter: char| !letter.is_alphanumeric()).next().unwrap_or_default().to_owned();
        Event::Error { during: during.to_owned(), kind, text: error.to_string(), engine }
    }

    /// Writes the report. If the reader has ended, this process ends, too.
    pub fn report(&self) {
        let line = serde_json::to_string(self).unwrap_or_default() + "\n";
        if std::io::stdout().lock().write_all(line.as_bytes()).is_err() {
            std::process::exit(0);
        }
    }
}

/// The monotonic clock, which is the same in all processes.
pub fn now() -> Duration {
    let time = clock_gettime(ClockId::Monotonic);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}
