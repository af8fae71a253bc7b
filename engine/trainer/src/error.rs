//! The errors of a run.

use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};

use endless_gym_core::pool::{PoolError, SnapshotError};
use endless_gym_service::ServiceError;
use thiserror::Error;

/// Why a run did not start, or stopped early.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum Error {
    /// A setting, or a combination of them, is invalid; the text says what is allowed.
    #[error("{0}")]
    Settings(String),
    /// The environment has actions or observations that the agents do not support.
    #[error("{id} cannot be learnt here: {what}")]
    Unsupported { id: String, what: &'static str },
    /// The folder has no run.
    #[error("no run in {0}; expected a folder with settings.json, as `endless learn` writes it; start a run there with --run {0}", run.display())]
    NoRun { run: PathBuf },
    /// The folder of a new run has another run.
    #[error("{0} already contains a run; continue it with --resume {0}, or choose another folder", run.display())]
    RunExists { run: PathBuf },
    /// Another process trains in the folder.
    #[error("{} is in use by {holder}; wait until it ends, or choose another folder", run.display())]
    RunInUse { run: PathBuf, holder: String },
    /// A checkpoint is missing, damaged, or does not fit.
    #[error("checkpoint {} {what}", path.display())]
    Checkpoint { path: PathBuf, what: String },
    /// The log of a run has no row of an update that its checkpoint contains.
    #[error(
        "{0}/progress.jsonl has no row of update {missing}, and the checkpoint is of update {update}; restore the file, or start a new \
         run with --init-from {0}",
        run.display()
    )]
    Progress { run: PathBuf, update: u64, missing: u64 },
    /// The loss, the gradient or the weights are no longer finite.
    #[error(
        "update {update} diverged: its {what} is {value}; try a smaller --ppo.learning-rate (now {learning_rate}) or \
         --ppo.max-gradient-norm (now {max_gradient_norm}); with --resume {}, which has a checkpoint of update {saved}",
        run.display()
    )]
    Diverged {
        /// Number of the update, from 1.
        update: u64,
        what: &'static str,
        value: f64,
        learning_rate: f64,
        max_gradient_norm: f64,
        run: PathBuf,
        saved: u64,
    },
    /// The environments failed, such as an engine that ended. The run is saved.
    #[error("{error}; the run is saved after update {update}; continue with: endless learn --resume {}", run.display())]
    Saved { error: Box<Error>, update: u64, run: PathBuf },
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    File { path: PathBuf, source: io::Error },
    /// A file or a text is not the expected JSON.
    #[error("{what} is not of this version of `endless learn`: {source}")]
    Json { what: String, source: serde_json::Error },
    /// The threads cannot be started.
    #[error("cannot start --threads {count}: {source}")]
    Threads { count: usize, source: rayon::ThreadPoolBuildError },
    /// The environments report an error.
    #[error(transparent)]
    Pool(#[from] PoolError),
    /// An environment cannot be saved or restored.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    /// The engine reports an error.
    #[error(transparent)]
    Service(#[from] ServiceError),
}

/// Turns an error of a file into an [`Error`].
pub(crate) fn file(path: &Path) -> impl FnOnce(io::Error) -> Error {
    let path = path.to_owned();
    |source| Error::File { path, source }
}

impl Error {
    /// Turns an error of JSON into an [`Error`].
    pub(crate) fn json(what: impl Display) -> impl FnOnce(serde_json::Error) -> Error {
        let what = what.to_string();
        |source| Error::Json { what, source }
    }
}
