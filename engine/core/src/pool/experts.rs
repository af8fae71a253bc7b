//! The scripted experts of a group of environments.

use thiserror::Error;

use super::autoreset::Autoreset;
use super::registry::{NoExpert, Registry};
use crate::batch::Batch;
use crate::envs::{Expert, UnknownEnvironment};

/// One scripted [`Expert`] for each environment of a pool, or of an engine's group. They read the feature observation of each
/// batch.
///
/// ```
/// use endless_gym_core::batch::{Batch, zeroed};
/// use endless_gym_memory_gym::memory_gym;
/// use endless_gym_core::pool::{Experts, Pool, PoolConfig, ResetRequest, Threads};
///
/// let config = PoolConfig::new("MortarMayhem-Grid-v0", 4).features(true);
/// let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1)?)?;
/// let mut experts = Experts::new(memory_gym(), &config.id, 4, config.autoreset)?;
/// let (mut blocks, mut actions) = (zeroed(pool.layout().blocks()), [0; 4]);
/// pool.reset(ResetRequest::Seed(1), &mut blocks)?;
/// for _ in 0..118 {
///     experts.act(&Batch::new(pool.layout(), &blocks), &mut actions)?;
///     pool.step(&actions, &mut blocks)?;
/// }
/// assert_eq!(Batch::new(pool.layout(), &blocks).terminated(), [1; 4]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Experts {
    experts: Vec<Box<dyn Expert>>,
    autoreset: Autoreset,
    features: usize,
    vector_observation: usize,
    branches: usize,
}

impl Experts {
    /// Experts for `num_envs` environments of `id` in the given autoreset mode.
    ///
    /// # Errors
    ///
    /// [`ExpertsError::UnknownEnvironment`] if the registry does not have the id, and [`ExpertsError::NoExpert`] if its family has
    /// no expert.
    pub fn new(registry: &Registry, id: &str, num_envs: usize, autoreset: Autoreset) -> Result<Self, ExpertsError> {
        let spec = registry.spec(id)?;
        Ok(Experts {
            experts: (0..num_envs).map(|_| registry.expert(id)).collect::<Result<_, _>>()?,
            autoreset,
            features: spec.features.len(),
            vector_observation: spec.vector_observation,
            branches: spec.action_space.width(),
        })
    }

    /// Chooses an action for every observation in `batch` and writes it to `actions`: one row for each environment, one number
    /// for each branch of the action space. Call it once for each batch, since the experts remember what they saw.
    ///
    /// # Errors
    ///
    /// [`ExpertsError`] if the batch has no features or another number of environments, or if `actions` has the wrong length.
    /// On an error, no expert acts.
    pub fn act(&mut self, batch: &Batch<'_>, actions: &mut [i32]) -> Result<(), ExpertsError> {
        let (features, vectors) = (batch.features(), batch.vector_observation());
        let (lengths, terminated, truncated) = (batch.episode_length(), batch.terminated(), batch.truncated());
        let num_envs = self.experts.len();
        let rows = [lengths.len(), terminated.len(), truncated.len()];
        let needed = num_envs * self.features;
        if features.len() != needed || vectors.len() != num_envs * self.vector_observation || rows != [num_envs; 3] {
            return Err(ExpertsError::Features { given: features.len(), needed, num_envs });
        }
        let needed = num_envs * self.branches;
        if actions.len() != needed {
            return Err(ExpertsError::Actions { given: actions.len(), needed });
        }
        let rows = self.experts.iter_mut().zip(actions.chunks_exact_mut(self.branches));
        for (env, (expert, action)) in rows.enumerate() {
            // With same-step autoreset, the row of an episode's last step has the first observation of the next episode.
            let ended = terminated[env] == 1 || truncated[env] == 1;
            if lengths[env] == 0 || ended && self.autoreset == Autoreset::SameStep {
                expert.reset();
            }
            let vector = &vectors[env * self.vector_observation..][..self.vector_observation];
            expert.act(&features[env * self.features..][..self.features], vector, action);
        }
        Ok(())
    }
}

/// Experts cannot be created, or cannot play a batch.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum ExpertsError {
    /// The registry does not have the id.
    #[error(transparent)]
    UnknownEnvironment(#[from] UnknownEnvironment),
    /// The id's family has no expert.
    #[error(transparent)]
    NoExpert(#[from] NoExpert),
    /// The batch has no features, or belongs to another id or another number of environments.
    #[error("experts need a batch with the {needed} features of {num_envs} environments, got {given} features")]
    Features { given: usize, needed: usize, num_envs: usize },
    /// Memory for the actions has the wrong length.
    #[error("the actions of the experts are {needed} numbers, got memory for {given}")]
    Actions { given: usize, needed: usize },
}
