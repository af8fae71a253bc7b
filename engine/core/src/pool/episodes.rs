//! Reset parameters for the next episodes, and the seeds and reset parameters of running ones.

use serde::{Deserialize, Serialize};

use super::config::OptionMap;

/// Reset parameters for the next episodes of some environments.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct NextOptions {
    /// Reset parameters by name; omitted ones have their defaults.
    pub options: OptionMap,
    /// Numbers of the environments in their pool.
    pub envs: Vec<usize>,
}

/// The seed and the reset parameters of an environment's running episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunningEpisode {
    /// Number of the environment in its pool.
    pub env: usize,
    /// The seed that the episode started with; `None` if it continued the previous episode's generator, or if the environment
    /// was seeded from entropy.
    pub seed: Option<u64>,
    /// The reset parameters that were given for the episode; omitted ones have their defaults.
    pub options: OptionMap,
    /// Whether the last step ended the episode. With next-step autoreset, the next step then starts another.
    pub ended: bool,
}
