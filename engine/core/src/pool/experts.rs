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
/// use endless_gym_core::memory_gym;
/// use endless_gym_core::pool::{Experts, Pool, PoolConfig, ResetRequest, Threads};
///
/// let config = PoolConfig { features: true, ..PoolConfig::new("MortarMayhem-Grid-v0", 4) };
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
            branches: spec.action_space.branches().len(),
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
pub enum ExpertsError {
    /// The registry does not have the id.
    #[error(transparent)]
    UnknownEnvironment(#[from] UnknownEnvironment),
    /// The id's family has no expert.
    #[error(transparent)]
    NoExpert(#[from] NoExpert),
    /// The batch has no features, or belongs to another id or another number of environments.
    #[error("experts need a batch with the {needed} features of {num_envs} environments, got {given} features")]
    Features {
        /// Features that the batch has.
        given: usize,
        /// Features that the experts read.
        needed: usize,
        /// Number of environments that the experts play.
        num_envs: usize,
    },
    /// Memory for the actions has the wrong length.
    #[error("the actions of the experts are {needed} numbers, got memory for {given}")]
    Actions {
        /// Length of the memory.
        given: usize,
        /// Numbers that the experts write.
        needed: usize,
    },
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::batch::zeroed;
    use crate::memory_gym;
    use crate::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};

    const NUM_ENVS: usize = 3;
    const EPISODES: usize = 3;

    /// Returns and lengths of the first episodes of each environment.
    type Episodes = [Vec<(f64, i32)>; NUM_ENVS];

    fn config(id: &str, autoreset: Autoreset) -> PoolConfig {
        let seeding = Seeding::List(vec![5, 6, 7, 8, 9, 10]);
        PoolConfig { features: true, frames: None, autoreset, seeding, ..PoolConfig::new(id, NUM_ENVS) }
    }

    /// Plays until every environment has finished [`EPISODES`] episodes.
    fn play(id: &str, autoreset: Autoreset) -> Episodes {
        let mut pool = Pool::new(memory_gym(), &config(id, autoreset), &Threads::new(1).unwrap()).unwrap();
        let mut blocks = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut blocks).unwrap();
        let mut experts = Experts::new(memory_gym(), id, NUM_ENVS, autoreset).unwrap();
        let mut actions = vec![0; NUM_ENVS * pool.spec().action_space.branches().len()];
        let mut episodes = Episodes::default();
        for _ in 0..5000 {
            experts.act(&Batch::new(pool.layout(), &blocks), &mut actions).unwrap();
            pool.step(&actions, &mut blocks).unwrap();
            let batch = Batch::new(pool.layout(), &blocks);
            let ended: Vec<u8> = batch.terminated().to_vec();
            for env in (0..NUM_ENVS).filter(|env| ended[*env] == 1) {
                episodes[env].push((batch.episode_return()[env], batch.episode_length()[env]));
            }
            if autoreset == Autoreset::Disabled && ended.contains(&1) {
                pool.reset(ResetRequest::Each { reset: &ended, seed: &[0; NUM_ENVS] }, &mut blocks).unwrap();
            }
            if episodes.iter().all(|episodes| episodes.len() >= EPISODES) {
                break;
            }
        }
        episodes.iter_mut().for_each(|episodes| episodes.truncate(EPISODES));
        episodes
    }

    /// The same episodes, each played by a new expert in a new environment.
    fn alone(id: &str) -> Episodes {
        let spec = memory_gym().spec(id).unwrap();
        std::array::from_fn(|env| {
            let episode = |number: usize| {
                let config = PoolConfig { num_envs: 1, total_envs: 1, ..config(id, Autoreset::Disabled) };
                let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).unwrap();
                let mut blocks = zeroed(pool.layout().blocks());
                let seed = 5 + (number * NUM_ENVS + env) as u64 % 6;
                pool.reset(ResetRequest::Seed(seed), &mut blocks).unwrap();
                let (mut expert, mut action) =
                    (memory_gym().expert(id).unwrap(), vec![0; spec.action_space.branches().len()]);
                loop {
                    let batch = Batch::new(pool.layout(), &blocks);
                    if batch.terminated()[0] == 1 {
                        return (batch.episode_return()[0], batch.episode_length()[0]);
                    }
                    expert.act(batch.features(), batch.vector_observation(), &mut action);
                    pool.step(&action, &mut blocks).unwrap();
                }
            };
            (0..EPISODES).map(episode).collect()
        })
    }

    #[test]
    fn experts_act_like_new_ones_in_every_episode_and_autoreset_mode() {
        for id in ["MortarMayhem-Grid-v0", "MortarMayhemB-Grid-v0", "MysteryPath-Grid-v0"] {
            let expected = alone(id);
            assert!(expected.iter().flatten().all(|(total, length)| *total > 0.0 && *length > 5), "{id}: {expected:?}");
            for mode in Autoreset::ALL {
                assert_eq!(play(id, mode), expected, "{id}, {mode}");
            }
        }
    }

    #[test]
    fn batches_and_actions_of_the_wrong_size_are_rejected() {
        let id = "MortarMayhemB-Grid-v0";
        let pool = |config: &PoolConfig| Pool::new(memory_gym(), config, &Threads::new(1).unwrap()).unwrap();
        let act = |pool: &Pool, actions: &mut [i32]| {
            let blocks = zeroed(pool.layout().blocks());
            Experts::new(memory_gym(), id, NUM_ENVS, Autoreset::NextStep)?
                .act(&Batch::new(pool.layout(), &blocks), actions)
        };
        let good = config(id, Autoreset::NextStep);
        let needed = NUM_ENVS * memory_gym().spec(id).unwrap().features.len();
        assert_eq!(act(&pool(&good), &mut [0; NUM_ENVS]), Ok(()));
        assert_eq!(act(&pool(&good), &mut [0; 2]), Err(ExpertsError::Actions { given: 2, needed: NUM_ENVS }));
        let plain = PoolConfig { features: false, ..good.clone() };
        let error = ExpertsError::Features { given: 0, needed, num_envs: NUM_ENVS };
        assert_eq!(act(&pool(&plain), &mut [0; NUM_ENVS]), Err(error));
        let fewer = PoolConfig { num_envs: 2, total_envs: 2, ..good };
        let error = ExpertsError::Features { given: needed / 3 * 2, needed, num_envs: NUM_ENVS };
        assert_eq!(act(&pool(&fewer), &mut [0; NUM_ENVS]), Err(error));
    }
}
