//! The errors of a pool.

use thiserror::Error;

use super::drawn_scene::WrongFrame;
use super::env_panic::EnvPanic;
use super::seeding::MAX_TOTAL_ENVS;
use crate::batch::limits::{MAX_ENVS, MAX_THREADS};
use crate::batch::{BLOCK_BYTES, LayoutError, MAX_STACK};
use crate::envs::{ActionError, ParameterError, UnknownEnvironment};
use crate::random::EntropyError;

/// A pool cannot be created, or a call fails.
///
/// Except for [`PoolError::WrongFrame`] and [`PoolError::Panic`], an error changes no environment and no batch.
#[derive(Debug, Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum PoolError {
    /// The registry has no environment with this id.
    #[error(transparent)]
    UnknownEnvironment(#[from] UnknownEnvironment),
    /// The reset parameters for all environments are invalid.
    #[error(transparent)]
    Parameters(#[from] ParameterError),
    /// An episode without a seed needs entropy, and none is available.
    #[error(transparent)]
    Entropy(#[from] EntropyError),
    /// The reset parameters of one environment are invalid.
    #[error("options of environment {env}: {source}")]
    ParametersOf {
        /// Number of the environment, counted over all pools.
        env: usize,
        source: ParameterError,
    },
    /// The number of sets of reset parameters differs from the number of environments.
    #[error("options must be one set for all environments or {num_envs} sets, one for each, got {given} sets")]
    OptionsCount { given: usize, num_envs: usize },
    /// There are no environments, or too many.
    #[error("num_envs must be 1 to {MAX_ENVS}, got {given}")]
    NumEnvs { given: usize },
    /// `total_envs` is less than `first_env + num_envs`, or too large.
    #[error(
        "total_envs must be first_env + num_envs to {MAX_TOTAL_ENVS}, got {total_envs} with first_env {first_env} and num_envs {num_envs}"
    )]
    EnvNumbers { first_env: usize, num_envs: usize, total_envs: usize },
    /// An observation has no frame, or too many.
    #[error("frame stack must be 1 to {MAX_STACK}, got {given}")]
    Stack { given: usize },
    /// The pool's batch would not fit into the address space.
    #[error(transparent)]
    Layout(#[from] LayoutError),
    /// The list of seeds is empty.
    #[error("the list of seeds must have at least one seed, got none")]
    NoSeeds,
    /// The range of seeds is empty or too large.
    #[error("the range of seeds must not be empty and must end at 2^63 - 1 or lower, got {start}..{end}")]
    SeedRange {
        start: u64,
        /// The end of the range, excluded.
        end: u64,
    },
    /// The step of the range of seeds is 0.
    #[error("the step of the range of seeds must be 1 or more, got 0")]
    SeedStep,
    /// The number of threads is out of range.
    #[error("threads must be 0 (one for each core) to {MAX_THREADS}, got {given}")]
    ThreadCount { given: usize },
    /// The operating system refuses to start a thread.
    #[error("cannot start {count} threads: {source}")]
    Threads {
        /// Number of threads, the calling one included.
        count: usize,
        source: std::io::Error,
    },
    /// There are fewer CPUs than threads to bind to them.
    #[error(
        "{given} pinned threads need a CPU each, and this process may use {cpus}; use fewer threads, or do not pin them"
    )]
    PinnedThreads {
        /// Number of threads, with those of other pools on the CPUs before theirs.
        given: usize,
        /// Number of CPUs in the affinity mask.
        cpus: usize,
    },
    /// A thread cannot be bound to a CPU.
    #[error("threads cannot be pinned: {source}")]
    Pin { source: std::io::Error },
    /// A call that needs running episodes came before the first reset of all environments.
    #[error("all environments must be reset before any other call")]
    NotReset,
    /// There are too few or too many actions, or one is out of range.
    #[error(transparent)]
    Action(#[from] ActionError),
    /// A reset request has the wrong length.
    #[error("a reset of single environments must have {num_envs} items, one for each environment, got {given}")]
    ResetCount { given: usize, num_envs: usize },
    /// The pool has no environment with this number.
    #[error("env must be 0 to {}, got {given}", num_envs - 1)]
    NoSuchEnv { given: usize, num_envs: usize },
    /// The environment has neither frames nor pictures, only features.
    #[error("{id} has no frames to show, only features")]
    NoFrame { id: &'static str },
    /// Only RGB frames have a luma.
    #[error("grayscale frames are for environments with 3 channels, and {id} has {channels}")]
    Grayscale { id: &'static str, channels: usize },
    /// Only with [`check_drawing`](super::PoolConfig::check_drawing): an updated frame differs from the same frame drawn in
    /// full.
    ///
    /// Some or all environments have advanced, and the batch is incomplete. It has no generation stamp, so the next write into
    /// it draws in full.
    #[error(transparent)]
    WrongFrame(#[from] WrongFrame),
    /// An environment panicked. Some environments have advanced, and the batch is incomplete. All environments must be reset before
    /// any other call, unless the call changes none.
    #[error(transparent)]
    Panic(#[from] EnvPanic),
    /// The memory for a batch is too small.
    #[error("a batch must have at least {needed} blocks of {BLOCK_BYTES} bytes, got {given}")]
    BatchTooShort { given: usize, needed: usize },
}
