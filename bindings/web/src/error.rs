//! Errors of the page's engine. Errors of reset parameters, actions and traces come unchanged from the core.

use endless_gym_core::envs::UnknownEnvironment;
use endless_gym_core::pool::{ExpertsError, NoExpert, PoolError, RegistryError};
use endless_gym_core::trace::TraceError;
use thiserror::Error;

use crate::agent::AgentFileError;

/// Why a request cannot be executed.
#[derive(Debug, Error)]
pub enum WebError {
    #[error("the request cannot be read: {0}")]
    Request(serde_json::Error),
    #[error("seed must be an integer, 0 to {}, got `{given}`", u64::MAX)]
    Seed { given: String },
    #[error("the page plays environments without arguments, got `{id}`")]
    Arguments { id: &'static str },
    #[error("there is no episode; start one first")]
    NoGame,
    #[error("there is no wall; start one first")]
    NoWall,
    #[error("the expert must play an episode from its first step, since it remembers what it has seen")]
    LateExpert,
    #[error("the agent must play an episode from its first step, since it remembers what it has seen")]
    LateAgent,
    #[error("no agent of {id} is loaded; load its file first")]
    NoAgent { id: &'static str },
    #[error("the agent was trained in {trained} and cannot play {played}")]
    OtherAgent { trained: String, played: &'static str },
    #[error(transparent)]
    AgentFile(#[from] AgentFileError),
    #[error("the episode is not a recorded one; it has no actions to replay")]
    NoScript,
    #[error("the recording has no more steps")]
    ScriptIsOver,
    #[error("a wall must have at least one environment and one column")]
    EmptyWall,
    #[error("the wall has no environment at this place")]
    NoTile,
    #[error("`{id}` has no frames, which a wall shows; play it alone")]
    NoFrame { id: &'static str },
    #[error(transparent)]
    Registry(#[from] RegistryError),
    #[error("the page needs at least one environment")]
    NoEnvironments,
    #[error(transparent)]
    UnknownEnvironment(#[from] UnknownEnvironment),
    #[error(transparent)]
    Pool(#[from] PoolError),
    #[error(transparent)]
    NoExpert(#[from] NoExpert),
    #[error(transparent)]
    Experts(#[from] ExpertsError),
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error("the recording cannot be written: {0}")]
    Write(#[from] std::io::Error),
}
