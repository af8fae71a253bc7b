//! The errors of the page's engine. Those of reset parameters, actions and traces are the core's, unchanged.

use endless_gym_core::envs::UnknownEnvironment;
use endless_gym_core::pool::{ExpertsError, PoolError};
use endless_gym_core::trace::TraceError;
use thiserror::Error;

use crate::agent::AgentFileError;

/// A request that cannot be carried out.
#[derive(Debug, Error)]
pub enum WebError {
    /// The request is not JSON, or none of the requests.
    #[error("the request cannot be read: {0}")]
    Request(serde_json::Error),
    /// No seed.
    #[error("seed must be an integer, 0 to {}, got `{given}`", u64::MAX)]
    Seed {
        /// The given text.
        given: String,
    },
    /// A step or a file was asked for before an episode.
    #[error("there is no episode; start one first")]
    NoGame,
    /// A step of the wall was asked for before there was one.
    #[error("there is no wall; start one first")]
    NoWall,
    /// The expert has not seen the episode's observations.
    #[error("the expert must play an episode from its first step, since it remembers what it has seen")]
    LateExpert,
    /// The agent has not seen the episode's observations.
    #[error("the agent must play an episode from its first step, since it remembers what it has seen")]
    LateAgent,
    /// No agent of that environment was loaded.
    #[error("no agent of {id} is loaded; load its file first")]
    NoAgent {
        /// The environment of the episode.
        id: &'static str,
    },
    /// The agent was trained in another environment, or with other observations or actions.
    #[error("the agent was trained in {trained} and cannot play {played}")]
    OtherAgent {
        /// The environment of the agent.
        trained: String,
        /// The environment of the episode.
        played: &'static str,
    },
    /// The file is no agent.
    #[error(transparent)]
    AgentFile(#[from] AgentFileError),
    /// The episode is not a trace's.
    #[error("the episode is not a recorded one; it has no actions to replay")]
    NoScript,
    /// The trace has no steps left.
    #[error("the recording has no more steps")]
    ScriptIsOver,
    /// A wall without environments, or without columns.
    #[error("a wall must have at least one environment and one column")]
    EmptyWall,
    /// No environment has that id.
    #[error(transparent)]
    UnknownEnvironment(#[from] UnknownEnvironment),
    /// The engine refuses.
    #[error(transparent)]
    Pool(#[from] PoolError),
    /// The experts refuse.
    #[error(transparent)]
    Experts(#[from] ExpertsError),
    /// The file is no trace.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// The trace cannot be written.
    #[error("the recording cannot be written: {0}")]
    Write(#[from] std::io::Error),
}
