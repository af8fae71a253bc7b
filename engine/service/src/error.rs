//! What can go wrong between an engine, its trainer and its observers.

use std::path::PathBuf;
use std::time::Duration;

use thiserror::Error;

use endless_gym_core::batch::{LAYOUT_VERSION, OPTIONS_BYTES, SNAPSHOT_BYTES};
use endless_gym_core::envs::ActionError;
use endless_gym_core::pool::PoolError;

/// Version of this package, as a message names it.
pub(super) const PACKAGE_VERSION: &str = env!("CARGO_PKG_VERSION");

/// An engine, trainer or observer that cannot be made, or a call that cannot be carried out.
#[derive(Debug, Error)]
pub enum ServiceError {
    #[error("`{given}` cannot name an engine; give 1 to {longest} letters, digits, `.`, `_` or `-`")]
    InvalidName { given: String, longest: usize },
    #[error(
        "cannot use {} as the directory where engines and trainers meet: {reason}; another one can be given in ENDLESS_GYM_ROOT",
        path.display()
    )]
    Root { path: PathBuf, reason: String },
    #[error(
        "no engine `{service}` under {}; there {known}. Start one, or set ENDLESS_GYM_ROOT to the same directory for both",
        root.display()
    )]
    UnknownEngine { service: String, root: PathBuf, known: String },
    #[error("an engine `{service}` is already running{}; stop it or give this one another name", of_process(*pid))]
    EngineExists { service: String, pid: Option<u32> },
    #[error(
        "engine `{service}` already has a trainer{}, and takes one only; stop that trainer, or watch with an observer",
        of_process(*pid)
    )]
    TrainerExists { service: String, pid: Option<u32> },
    #[error(
        "engine `{service}` has no room for another observer; stop one, or start the engine with more than {limit}"
    )]
    TooManyObservers { service: String, limit: usize },
    #[error(
        "engine `{service}` speaks layout version {layout} (endless-gym {package}), this process layout version \
         {LAYOUT_VERSION} (endless-gym {PACKAGE_VERSION}); install the same version for both"
    )]
    Version { service: String, layout: String, package: String },
    #[error("engine `{service}` sends messages of another type; install the same version of endless-gym for both")]
    IncompatibleTypes { service: String },
    #[error("the specification of engine `{service}` cannot be read: {reason}")]
    Specification { service: String, reason: String },
    #[error("{given} groups asked for; an engine serves 1 to {limit}")]
    Groups { given: usize, limit: usize },
    #[error("{given} is not a number of {what}; give {lowest} to {highest}")]
    Limit { what: &'static str, given: usize, lowest: usize, highest: usize },
    #[error(
        "the batches need {} MB of shared memory and {path} has {} MB left; run fewer environments or groups, or make it \
         larger (`docker run --shm-size`, `mount -o remount,size=... /dev/shm`)",
        megabytes(*needed), available / 1_000_000
    )]
    SharedMemoryTooSmall { needed: u64, available: u64, path: &'static str },
    #[error("there is no group {given}; engine `{service}` has groups 0 to {}", groups.saturating_sub(1))]
    NoSuchGroup { service: String, given: usize, groups: usize },
    #[error(transparent)]
    Action(#[from] ActionError),
    #[error("a reset with {given} flags or seeds asked of {num_envs} environments; give one of both for each")]
    ResetCount { given: usize, num_envs: usize },
    #[error(
        "reset parameters of {given} bytes as JSON; a message takes {OPTIONS_BYTES}, so give lists with fewer items"
    )]
    OptionsTooLong { given: usize },
    #[error("a snapshot of {given} bytes; a message to an engine takes {SNAPSHOT_BYTES}, so restore it in a pool")]
    SnapshotTooLong { given: usize },
    #[error("group {group} still owes the answer to the last message; receive it before the next reset or step")]
    AnswerPending { group: usize },
    #[error("nothing was sent to group {group}; reset or step it before receiving")]
    NothingSent { group: usize },
    #[error(
        "{limit} batches of group {group} are held and no more can be lent; drop one, or copy what you want to keep"
    )]
    TooManyBatchesHeld { group: usize, limit: usize },
    #[error("no answer of engine `{service}` within {waited:?}; it is alive, so wait longer for large batches")]
    TimedOut { service: String, waited: Duration },
    #[error("engine `{service}`{} has ended; start it again and reconnect", of_process(Some(*pid)))]
    EngineLost { service: String, pid: u32 },
    #[error("engine `{service}` was restarted, and its episodes are gone; reconnect, then reset")]
    EngineRestarted { service: String },
    #[error("engine `{service}` was restarted with another {what}; connect anew")]
    SpecificationChanged { service: String, what: &'static str },
    #[error("engine `{service}` rejected the message for group {group}: {message}")]
    Rejected { service: String, group: usize, reason: Rejection, message: String },
    #[error(transparent)]
    Pool(#[from] PoolError),
    #[error("{action}: {reason}")]
    Middleware { action: &'static str, reason: String },
}

impl ServiceError {
    /// Wraps an error of the middleware that has no case of its own.
    pub(super) fn middleware(action: &'static str) -> impl Fn(String) -> Self {
        move |reason| ServiceError::Middleware { action, reason }
    }
}

/// Why an engine rejected a message. No environment has moved.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rejection {
    /// The message is of another layout version.
    Version,
    /// The engine does not know this kind of message.
    Kind,
    /// The payload is shorter than the layout says.
    Payload,
    /// This trainer has not reset all environments of the group yet.
    NotReset,
    /// An action is out of range, or another error of the pool.
    Pool,
    /// The reset parameters are no JSON object.
    Options,
    /// A snapshot cannot be taken or gone on from.
    Snapshot,
}

impl Rejection {
    const ALL: [Rejection; 7] = [
        Rejection::Version,
        Rejection::Kind,
        Rejection::Payload,
        Rejection::NotReset,
        Rejection::Pool,
        Rejection::Options,
        Rejection::Snapshot,
    ];

    /// The status in a header: 0 is for batches.
    pub(super) fn status(self) -> u32 {
        self as u32 + 1
    }

    /// The rejection that a header's status stands for.
    pub(super) fn from_status(status: u32) -> Option<Self> {
        Rejection::ALL.into_iter().find(|rejection| rejection.status() == status)
    }
}

fn of_process(pid: Option<u32>) -> String {
    pid.map_or_else(String::new, |pid| format!(" (process {pid})"))
}

/// Rounded up, so that a need never reads as being met.
fn megabytes(bytes: u64) -> u64 {
    bytes.div_ceil(1_000_000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_rejection_survives_the_header() {
        for rejection in Rejection::ALL {
            assert_eq!(Rejection::from_status(rejection.status()), Some(rejection));
        }
        assert_eq!(Rejection::from_status(0), None);
        assert_eq!(Rejection::from_status(99), None);
    }

    #[test]
    fn messages_say_both_versions() {
        let text =
            ServiceError::Version { service: "a".into(), layout: "7".into(), package: "9.9.9".into() }.to_string();
        for part in ["layout version 7", "9.9.9", &format!("layout version {LAYOUT_VERSION}"), PACKAGE_VERSION] {
            assert!(text.contains(part), "{text}");
        }
    }
}
