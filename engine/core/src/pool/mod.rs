//! Many environments of one id, stepped in lockstep by the calling thread and worker threads.
//!
//! [`Pool`] owns the environments and writes batches, [`PoolConfig`] configures it, and [`Threads`] are the threads it runs on.

mod autoreset;
mod buffers;
mod config;
#[allow(unsafe_code)] // Threads step disjoint parts of the environments.
mod division;
mod drawn_scene;
mod env_panic;
mod env_slot;
mod episodes;
mod error;
mod experts;
mod frame_stack;
#[expect(clippy::module_inception, reason = "the file of the type `Pool`")]
mod pool;
mod registry;
mod seeding;
mod snapshot;
mod sync;
mod threads;
mod typed_envs;

pub use crate::batch::limits::{MAX_ENVS, MAX_THREADS};
pub use autoreset::{Autoreset, UnknownAutoreset};
pub use config::{EnvReset, OptionMap, PoolConfig, ResetOptions, ResetRequest};
pub use drawn_scene::WrongFrame;
pub use env_panic::EnvPanic;
pub use episodes::{NextOptions, RunningEpisode};
pub use error::PoolError;
pub use experts::{Experts, ExpertsError};
pub use pool::Pool;
pub use registry::{NoExpert, Registry, RegistryError};
pub use seeding::Seeding;
pub(crate) use snapshot::HEAD;
pub use snapshot::{ResumeError, SNAPSHOT_VERSION, SavedEnv, SnapshotError};
pub use threads::{StepTimes, Threads};

pub(crate) use env_panic::message;
