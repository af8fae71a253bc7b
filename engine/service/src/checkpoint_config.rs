//! Where an engine saves its environments, and what can go wrong.

use std::path::PathBuf;
use std::time::Duration;

use endless_gym_core::pool::{ResumeError, SnapshotError};
use thiserror::Error;

/// Version of the format of a checkpoint. It changes with every change to the content.
pub const CHECKPOINT_VERSION: u32 = 1;

/// Where an engine saves its environments, and whether it continues from there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckpointConfig {
    /// The file. A new checkpoint is written beside it, as `FILE.new`, and replaces it when it is complete and on the disk. As long as
    /// the engine exists, it holds a lock on `FILE.lock`, so that no other engine saves to the same file.
    pub path: PathBuf,
    /// How often the engine saves while it runs; `None` saves only when the engine stops and when a trainer asks for it.
    pub every: Option<Duration>,
    /// Whether the engine continues from the file if it exists. Otherwise a file that exists is an error, so that it is not
    /// overwritten by mistake.
    pub resume: bool,
}

impl CheckpointConfig {
    /// Saves to `path` when the engine stops and when a trainer asks for it, and does not continue from there.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        CheckpointConfig { path: path.into(), every: None, resume: false }
    }
}

/// A checkpoint that cannot be saved or used.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum CheckpointError {
    /// The interval is zero.
    #[error("the interval between checkpoints must be positive")]
    Interval,
    /// There is a file, and the engine was not asked to resume.
    #[error(
        "checkpoint {} exists; resume from it (`--resume`), move it away, or choose another file",
        path.display()
    )]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// Another engine saves to the file.
    #[error(
        "checkpoint {} is in use by another engine{}; stop it, or choose another file",
        path.display(),
        process.map(|process| format!(" (process {process})")).unwrap_or_default()
    )]
    InUse {
        /// The file.
        path: PathBuf,
        /// Process id of that engine; `None` if it cannot be read.
        process: Option<u32>,
    },
    /// The file cannot be read.
    #[error("checkpoint {} cannot be read: {reason}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// The file cannot be written. An earlier checkpoint is kept.
    #[error("checkpoint {} cannot be written: {reason}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// The file does not start with `EGYC`.
    #[error("{} is not a checkpoint of an engine", path.display())]
    NoCheckpoint {
        /// The file.
        path: PathBuf,
    },
    /// The checkpoint was saved by a version of this crate with another format.
    #[error(
        "checkpoint {} must be of version {CHECKPOINT_VERSION}, got version {given}; resume with the version of endless-gym that \
         saved it",
        path.display()
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// The version of the checkpoint.
        given: u32,
    },
    /// The checksum differs, or the content cannot be decoded.
    #[error("checkpoint {} is damaged: {reason}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The checkpoint is of other environments.
    #[error("checkpoint {} was saved with {what} {saved}, and the engine has {given}", path.display())]
    Mismatch {
        /// The file.
        path: PathBuf,
        /// The property that differs.
        what: &'static str,
        /// Its value in the checkpoint.
        saved: String,
        /// Its value in the engine's configuration.
        given: String,
    },
    /// The state of a group is not valid.
    #[error("checkpoint {}, group {group}: {source}", path.display())]
    Group {
        /// The file.
        path: PathBuf,
        /// The group.
        group: usize,
        /// What is wrong.
        source: ResumeError,
    },
    /// The state of an environment cannot be encoded.
    #[error("the environments cannot be saved: {source}")]
    State {
        /// Why.
        source: SnapshotError,
    },
    /// The engine has no file to save to.
    #[error("the engine has no checkpoint file; start it with one (`--checkpoint FILE`)")]
    NoFile,
    /// No group was reset, so there is nothing to save.
    #[error("there is nothing to save before the first reset")]
    NotReset,
}
