//! Errors of engines, trainers and observers.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use endless_gym_core::batch::{LAYOUT_VERSION, OPTIONS_BYTES, SNAPSHOT_BYTES};
use endless_gym_core::envs::ActionError;
use endless_gym_core::pool::{PoolError, ResumeError, SnapshotError};
use thiserror::Error;

use crate::os::process::LockHolder;
use crate::os::resource_limits;

/// Version of this package, for messages about versions that differ.
pub(crate) const PACKAGE_VERSION: &str = env!("CARGO_PKG_VERSION");

/// Why an engine, trainer or observer could not be created, or a call on one failed.
#[derive(Debug, Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum ServiceError {
    /// An engine name is malformed.
    #[error("engine name must be 1 to {max_length} letters, digits, `.`, `_` or `-`, got `{given}`")]
    InvalidName {
        given: String,
        /// Maximum length in bytes.
        max_length: usize,
    },
    /// The root directory of the namespace cannot be used.
    #[error("root directory {} cannot be used: {reason}; set ENDLESS_GYM_ROOT to another directory", path.display())]
    Root { path: PathBuf, reason: String },
    /// The namespace's directory, or the file in it that identifies the namespace, was removed or replaced while this process used
    /// it.
    #[error(
        "root directory {} was removed or replaced while it was in use, so engines and trainers no longer find each other there; \
         reconnect, or start the engine again; set ENDLESS_GYM_ROOT to a directory that nothing cleans up",
        path.display()
    )]
    RootRemoved { path: PathBuf },
    /// Another user has created a shared memory segment with the names of this namespace.
    #[error(
        "{} belongs to user {owner}, and segments of the namespace {} must belong to user {}, who runs this process; end the \
         engines and trainers of this namespace and try again, or set ENDLESS_GYM_ROOT to another directory",
        path.display(), root.display(), rustix::process::getuid().as_raw()
    )]
    ForeignSegment { path: PathBuf, owner: u32, root: PathBuf },
    /// Another process held the namespace's lock for too long.
    #[error(
        "root directory {} has been locked for {waited:?} by {}",
        path.display(), LockHolder::text(*holder)
    )]
    NamespaceLocked { path: PathBuf, waited: Duration, holder: Option<LockHolder> },
    /// An engine of that name is running but cannot be used: it is starting or ending, or some of its files were
    /// removed.
    #[error("engine `{service}` is running and cannot be reached; try again, and restart it if the error stays")]
    EngineUnreachable { service: String },
    /// No engine of that name is running.
    #[error(
        "no engine `{service}` is running in {}; running engines: {}; start it, or set ENDLESS_GYM_ROOT to the same directory for both \
         processes",
        root.display(), names(running)
    )]
    UnknownEngine { service: String, root: PathBuf, running: Vec<String> },
    /// An engine of that name is already running.
    #[error("engine `{service}` is already running{}; stop it, or choose another name", in_process(*pid))]
    EngineExists { service: String, pid: Option<u32> },
    /// The engine already has a trainer.
    #[error(
        "engine `{service}` already has a trainer{} and accepts only one; stop that trainer, or connect as an observer",
        in_process(*pid)
    )]
    TrainerExists { service: String, pid: Option<u32> },
    /// The engine already has as many observers as it accepts.
    #[error(
        "engine `{service}` already has {limit} observers; stop one, or start the engine with a larger `observers`"
    )]
    TooManyObservers { service: String, limit: usize },
    /// The engine uses another version of the memory layout or of iceoryx2.
    #[error(
        "engine `{service}` must have layout version {LAYOUT_VERSION} (endless-gym {PACKAGE_VERSION}), got {layout} (endless-gym \
         {package}); install the same version for both processes"
    )]
    Version {
        service: String,
        /// Its layout version, or `unknown`.
        layout: String,
        /// Its package version, or what is known of it.
        package: String,
    },
    /// The engine's messages have another type.
    #[error("engine `{service}` uses other message types; install the same version of endless-gym for both processes")]
    IncompatibleTypes { service: String },
    /// The engine's specification is malformed.
    #[error(
        "specification of engine `{service}` is invalid: {reason}; install the same version of endless-gym for both processes"
    )]
    Specification { service: String, reason: String },
    /// A number of an [`EngineConfig`](crate::EngineConfig) is out of range.
    #[error("{name} must be {lowest} to {highest}, got {given}")]
    OutOfRange { name: &'static str, given: usize, lowest: usize, highest: usize },
    /// A timeout is negative or not finite.
    #[error("timeout must be finite and not negative, got {given}")]
    InvalidTimeout {
        /// The timeout that was given, in seconds.
        given: f64,
    },
    /// There is not enough free shared memory.
    #[error(
        "{} MB of shared memory are needed, and {path} has {} MB free; use fewer environments or groups, or enlarge it \
         (`docker run --shm-size`, `mount -o remount,size=... /dev/shm`)",
        megabytes(*needed), available / 1_000_000
    )]
    SharedMemoryTooSmall {
        /// Bytes that are needed.
        needed: u64,
        /// Bytes that are free.
        available: u64,
        path: &'static str,
    },
    /// The control group of this process may not have as much memory.
    #[error(
        "{} MB of shared memory are needed, and the control group of this process (a container or a batch job) is limited to {} MB; \
         use fewer environments or groups, or raise the limit (`docker run --memory`, `sbatch --mem`)",
        megabytes(*needed), limit / 1_000_000
    )]
    MemoryLimit {
        /// Bytes that are needed.
        needed: u64,
        /// Bytes that the group may have.
        limit: u64,
    },
    /// The process may not open enough file descriptors.
    #[error(
        "{needed} file descriptors are needed, and the limit of this process is {limit}; raise it with `ulimit -n {needed}`, or use \
         fewer groups or observers"
    )]
    DescriptorLimit {
        /// Descriptors that are needed, including those already open.
        needed: u64,
        limit: u64,
    },
    /// The engine has no group of that number.
    #[error("group must be 0 to {} in engine `{service}`, got group {given}", groups.saturating_sub(1))]
    NoSuchGroup { service: String, given: usize, groups: usize },
    /// The groups are not those of one trainer.
    #[error(
        "the groups must belong to one trainer, and be all of its groups where a trainer is made of them or reconnects"
    )]
    MixedGroups,
    /// The number of actions is wrong, or an action is out of range. No environment has been stepped.
    #[error(transparent)]
    Action(#[from] ActionError),
    /// A reset request has the wrong length.
    #[error("a reset of single environments must have {num_envs} items, one for each environment, got {given}")]
    ResetCount { given: usize, num_envs: usize },
    /// Reset parameters do not fit into a message.
    #[error("reset parameters must have at most {OPTIONS_BYTES} bytes as JSON, got {given}; use shorter lists")]
    OptionsTooLong { given: usize },
    /// A snapshot does not fit into a message.
    #[error(
        "snapshot must have at most {SNAPSHOT_BYTES} bytes, got {given}; restore it with `Pool::restore` in this process"
    )]
    SnapshotTooLong { given: usize },
    /// The group has not answered the last request yet.
    #[error("group {group} has a pending answer; receive it before the next request")]
    AnswerPending { group: usize },
    /// The group has no request to answer.
    #[error("nothing was sent to group {group}; reset or step it before receiving")]
    NothingSent { group: usize },
    /// No group has a request to answer.
    #[error("no group has a pending answer; reset or step one before receiving")]
    NothingPending,
    /// The caller holds the maximum number of leases on batches of the group.
    #[error(
        "{limit} batches of group {group} are held, the maximum of this engine; drop one, or copy the data to keep"
    )]
    TooManyBatchesHeld { group: usize, limit: usize },
    /// No answer has arrived in time from an engine that is running.
    #[error("no answer from engine `{service}` within {waited:?}; {activity}")]
    TimedOut { service: String, waited: Duration, activity: EngineActivity },
    /// The engine's process has ended.
    #[error("engine `{service}`{} has ended; start it again and reconnect", in_process(Some(*pid)))]
    EngineLost { service: String, pid: u32 },
    /// The engine was replaced by another one of the same name.
    #[error("engine `{service}` was restarted, and its episodes are lost; reconnect and reset")]
    EngineRestarted { service: String },
    /// The engine was replaced by one that serves different environments.
    #[error("engine `{service}` was restarted with another {what}; create a new connection")]
    SpecificationChanged { service: String, what: &'static str },
    /// The engine rejected a request. Except for [`Rejection::Panic`], no environment has changed.
    #[error("engine `{service}` rejected the request for group {group}: {message}")]
    Rejected { service: String, group: usize, reason: Rejection, message: String },
    /// An environment of the engine panicked, and the engine ends: its code has a defect.
    #[error("the engine ends, since in group {group} {panic}")]
    Panic { group: usize, panic: String },
    /// The environments could not be created, or there is no environment of that number.
    #[error(transparent)]
    Pool(#[from] PoolError),
    /// The environments could not be saved, or not continued from a checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// iceoryx2 failed in a process whose memory or files are limited.
    #[error("{action}, and {limits}; raise the limit, or use fewer environments or groups ({reason})")]
    ResourceLimit { action: &'static str, limits: String, reason: String },
    /// The operating system refuses an operation on a file of the namespace.
    #[error("{action}: {}: {source}", path.display())]
    File { action: &'static str, path: PathBuf, source: io::Error },
    /// An unexpected error of iceoryx2.
    #[error("{action}: {reason}")]
    Middleware { action: &'static str, reason: String },
}

/// What a caller can do about a [`ServiceError`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// Correct the argument: it is out of range or malformed.
    Invalid,
    /// Make another call first, or drop a lease: the call does not fit what was called before.
    OutOfOrder,
    /// Try again: the engine is not running yet, or another process is busy in its namespace.
    Unavailable,
    /// Another process has the name or the place; end it, or choose another.
    InUse,
    /// Reconnect: the engine that this process was connected to has ended or cannot be found any more.
    Lost,
    /// Call again: the engine is running and has not answered in time.
    TimedOut,
    /// The engine has another version, or other environments than before: install the same version for all processes, or create a
    /// new connection.
    Incompatible,
    /// Raise a limit, or choose another directory: memory, descriptors or files are not available.
    Resources,
    /// The engine rejected the request and says why.
    Rejected,
    /// The environments or their checkpoint failed.
    Environments,
    /// Nothing is known that would help.
    Other,
}

impl ServiceError {
    /// What the caller can do.
    pub fn kind(&self) -> ErrorKind {
        use ServiceError as E;
        match self {
            E::InvalidName { .. }
            | E::OutOfRange { .. }
            | E::InvalidTimeout { .. }
            | E::NoSuchGroup { .. }
            | E::MixedGroups
            | E::Action(_)
            | E::ResetCount { .. }
            | E::OptionsTooLong { .. }
            | E::SnapshotTooLong { .. } => ErrorKind::Invalid,
            E::AnswerPending { .. } | E::NothingSent { .. } | E::NothingPending | E::TooManyBatchesHeld { .. } => {
                ErrorKind::OutOfOrder
            }
            E::UnknownEngine { .. } | E::EngineUnreachable { .. } | E::NamespaceLocked { .. } => ErrorKind::Unavailable,
            E::EngineExists { .. } | E::TrainerExists { .. } | E::TooManyObservers { .. } => ErrorKind::InUse,
            E::EngineLost { .. } | E::EngineRestarted { .. } | E::RootRemoved { .. } => ErrorKind::Lost,
            E::TimedOut { .. } => ErrorKind::TimedOut,
            E::Version { .. }
            | E::IncompatibleTypes { .. }
            | E::Specification { .. }
            | E::SpecificationChanged { .. } => ErrorKind::Incompatible,
            E::Root { .. }
            | E::ForeignSegment { .. }
            | E::SharedMemoryTooSmall { .. }
            | E::MemoryLimit { .. }
            | E::DescriptorLimit { .. }
            | E::ResourceLimit { .. }
            | E::File { .. } => ErrorKind::Resources,
            E::Rejected { .. } => ErrorKind::Rejected,
            E::Pool(_) | E::Checkpoint(_) | E::Panic { .. } => ErrorKind::Environments,
            E::Middleware { .. } => ErrorKind::Other,
        }
    }

    /// Wraps an error of an operation on a file.
    pub(crate) fn file(action: &'static str, path: &Path) -> impl Fn(io::Error) -> Self {
        move |source| ServiceError::File { action, path: path.to_owned(), source }
    }

    /// Wraps an iceoryx2 error that has no variant of its own.
    pub(crate) fn middleware<E: fmt::Display>(action: &'static str) -> impl Fn(E) -> Self {
        move |error| {
            let reason = error.to_string();
            match resource_limits::text() {
                Some(limits) => ServiceError::ResourceLimit { action, limits, reason },
                None => ServiceError::Middleware { action, reason },
            }
        }
    }
}

/// Why an engine rejected a request. Except for [`Rejection::Panic`], no environment has changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Rejection {
    /// The request has another layout version.
    Version,
    /// The engine does not know the kind of the request.
    Kind,
    /// The payload is shorter than the layout.
    Payload,
    /// This trainer has not yet reset all environments of the group.
    NotReset,
    /// An action is out of range, or the pool reports another error.
    Pool,
    /// The reset parameters are not a JSON object.
    Options,
    /// A snapshot cannot be taken or restored.
    Snapshot,
    /// The checkpoint cannot be saved.
    Checkpoint,
    /// An environment panicked, and the engine ends.
    Panic,
}

impl Rejection {
    const ALL: [Rejection; 9] = [
        Rejection::Version,
        Rejection::Kind,
        Rejection::Payload,
        Rejection::NotReset,
        Rejection::Pool,
        Rejection::Options,
        Rejection::Snapshot,
        Rejection::Checkpoint,
        Rejection::Panic,
    ];

    /// The status in a response header. 0 is the status of a batch.
    pub(crate) fn status(self) -> u32 {
        self as u32 + 1
    }

    /// The rejection of a status in a response header.
    pub(crate) fn from_status(status: u32) -> Option<Self> {
        Rejection::ALL.into_iter().find(|rejection| rejection.status() == status)
    }
}

fn in_process(pid: Option<u32>) -> String {
    pid.map_or_else(String::new, |pid| format!(" (process {pid})"))
}

fn names(engines: &[String]) -> String {
    if engines.is_empty() { "none".to_owned() } else { engines.join(", ") }
}

/// Rounded up, so that the need never appears smaller than the free space.
fn megabytes(bytes: u64) -> u64 {
    bytes.div_ceil(1_000_000)
}

/// What an engine was doing when an answer or an observed batch did not arrive in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum EngineActivity {
    /// Its process is running; its status cannot be read.
    Unknown,
    /// It is executing a request.
    Busy {
        /// The group of the request.
        group: usize,
        /// The kind of the request: `step`, `reset`, `snapshot`, `restore`, `checkpoint`, `options` or `episodes`.
        kind: &'static str,
        /// How long it has been executing it.
        since: Duration,
        /// Process id of the engine.
        process: u32,
    },
    /// It is idle and has not taken the request: its process is stopped or gets no CPU time.
    NotTaken {
        /// Process id of the engine.
        process: u32,
    },
    /// It has answered the request; the answer can be received.
    Answered,
    /// It is idle, and there is no request for the observed group.
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

/// Version of the checkpoint format. It changes with every change to the content.
pub const CHECKPOINT_VERSION: u32 = 1;

/// A checkpoint that cannot be saved or used.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum CheckpointError {
    /// The interval is zero.
    #[error("the interval between checkpoints must be positive")]
    Interval,
    /// The file exists, and the engine was not asked to resume.
    #[error(
        "checkpoint {} exists; resume from it (`--resume`), move it away, or choose another file",
        path.display()
    )]
    Exists { path: PathBuf },
    /// Another engine saves to the file.
    #[error(
        "checkpoint {} is in use by another engine{}; stop it, or choose another file",
        path.display(),
        process.map(|process| format!(" (process {process})")).unwrap_or_default()
    )]
    InUse { path: PathBuf, process: Option<u32> },
    /// The file cannot be read.
    #[error("checkpoint {} cannot be read: {reason}", path.display())]
    Read { path: PathBuf, reason: String },
    /// The file cannot be written. An earlier checkpoint is kept.
    #[error("checkpoint {} cannot be written: {reason}", path.display())]
    Write { path: PathBuf, reason: String },
    /// The file does not start with `EGYC`.
    #[error("{} is not a checkpoint of an engine", path.display())]
    NoCheckpoint { path: PathBuf },
    /// The checkpoint was saved by a version of this crate with another format.
    #[error(
        "checkpoint {} must be of version {CHECKPOINT_VERSION}, got version {given}; resume with the version of endless-gym that \
         saved it",
        path.display()
    )]
    Version { path: PathBuf, given: u32 },
    /// The checksum differs, or the content cannot be decoded.
    #[error("checkpoint {} is damaged: {reason}", path.display())]
    Damaged { path: PathBuf, reason: String },
    /// The checkpoint was saved by an engine with other environments.
    #[error("checkpoint {} was saved with {what} {saved}, and the engine has {given}", path.display())]
    Mismatch { path: PathBuf, what: &'static str, saved: String, given: String },
    /// The state of a group is not valid.
    #[error("checkpoint {}, group {group}: {source}", path.display())]
    Group { path: PathBuf, group: usize, source: ResumeError },
    /// The state of an environment cannot be encoded.
    #[error("the environments cannot be saved: {source}")]
    State { source: SnapshotError },
    /// The engine has no file to save to.
    #[error("the engine has no checkpoint file; start it with one (`--checkpoint FILE`)")]
    NoFile,
    /// No group has been reset, so there is nothing to save.
    #[error("there is nothing to save before the first reset")]
    NotReset,
}
