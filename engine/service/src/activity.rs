//! What an engine was doing when an answer or a batch did not arrive in time.

use std::fmt;
use std::time::Duration;

/// What an engine was doing when an answer, or a batch that is observed, did not arrive in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EngineActivity {
    /// Its process is running; its status cannot be read.
    Unknown,
    /// It is executing a request.
    Busy {
        /// The group of the request.
        group: usize,
        /// The kind of the request: `step`, `reset`, `snapshot`, `restore` or `checkpoint`.
        kind: &'static str,
        /// How long it has been executing it.
        since: Duration,
        /// Process id of the engine.
        process: u32,
    },
    /// It executes nothing and has not taken the request: its process is stopped or gets no processor time.
    NotTaken {
        /// Process id of the engine.
        process: u32,
    },
    /// It has answered the request; the answer can be received.
    Answered,
    /// It executes nothing, and there is no request for the group that is observed.
    Idle {
        /// The group.
        group: usize,
        /// Time since the group's last request; `None` if it had none.
        since: Option<Duration>,
        /// Process id of the engine.
        process: u32,
    },
}

impl fmt::Display for EngineActivity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            EngineActivity::Unknown => write!(f, "the engine is running, use a longer timeout"),
            EngineActivity::Busy { group, kind, since, process } => {
                let seconds = since.as_secs_f64();
                write!(f, "the {kind} of group {group} has been running for {seconds:.1} s (engine process {process})")
            }
            EngineActivity::NotTaken { process } => write!(
                f,
                "the engine (process {process}) has not taken the request and executes nothing; its process may be stopped"
            ),
            EngineActivity::Idle { group, since: Some(since), process } => {
                let seconds = since.as_secs_f64();
                write!(
                    f,
                    "the trainer has requested nothing of group {group} for {seconds:.1} s (engine process {process})"
                )
            }
            EngineActivity::Idle { group, since: None, process } => {
                write!(f, "no trainer has requested anything of group {group} yet (engine process {process})")
            }
            EngineActivity::Answered => write!(f, "the engine has just answered; receive the answer"),
        }
    }
}
