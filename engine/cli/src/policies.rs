//! Policies for the demo and the benchmark, and statistics of the episodes that they play.

use clap::ValueEnum;
use endless_gym_core::batch::Batch;
use endless_gym_core::envs::{ActionSpace, EnvSpec, finite_bounds};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

/// The policy that chooses actions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Policy {
    /// A scripted policy with memory that reads the feature observation.
    Expert,
    /// Uniformly random actions.
    Random,
}

/// Uniformly random actions from a seed.
pub struct RandomPolicy {
    space: ActionSpace,
    random: SmallRng,
}

impl RandomPolicy {
    /// A policy for the action space of `spec`.
    pub fn new(spec: &EnvSpec, seed: u64) -> Self {
        RandomPolicy { space: spec.action_space.clone(), random: SmallRng::seed_from_u64(seed) }
    }

    /// Fills `actions`: one row per environment. Infinite bounds of a box are replaced by [`finite_bounds`] with a width of 1.
    pub fn act(&mut self, actions: &mut [i32]) {
        let RandomPolicy { space, random } = self;
        for action in actions.chunks_exact_mut(space.width()) {
            if let ActionSpace::Box { low, high } = space {
                for (number, (low, high)) in action.iter_mut().zip(low.iter().zip(high.iter())) {
                    let (low, high) = finite_bounds(*low, *high, 1.0);
                    *number = (low + random.random::<f32>() * (high - low)).to_bits().cast_signed();
                }
            }
            for (number, choices) in action.iter_mut().zip(space.branches()) {
                *number = random.random_range(0..*choices);
            }
        }
    }
}

/// Statistics of the episodes that have ended.
#[derive(Clone, Debug)]
pub struct EpisodeStatistics {
    /// Steps of all environments.
    pub steps: u64,
    /// Episodes that have ended.
    pub episodes: u64,
    returns: f64,
    lengths: f64,
    info: Vec<f64>,
    /// Mean return so far of the episodes in the last added batch.
    pub running_return: f64,
}

impl EpisodeStatistics {
    /// Statistics without episodes.
    pub fn new(spec: &EnvSpec) -> Self {
        EpisodeStatistics {
            steps: 0,
            episodes: 0,
            returns: 0.0,
            lengths: 0.0,
            info: vec![0.0; spec.info.len()],
            running_return: 0.0,
        }
    }

    /// Adds one step of a group.
    pub fn add(&mut self, batch: &Batch<'_>) {
        let num_envs = batch.layout().num_envs();
        self.steps += num_envs as u64;
        self.running_return = batch.episode_return().iter().sum::<f64>() / num_envs as f64;
        let info = batch.info();
        for env in (0..num_envs).filter(|env| batch.has_ended(*env)) {
            self.episodes += 1;
            self.returns += batch.episode_return()[env];
            self.lengths += f64::from(batch.episode_length()[env]);
            let columns = self.info.len();
            for (sum, value) in self.info.iter_mut().zip(&info[env * columns..]) {
                *sum += value;
            }
        }
    }

    fn mean(&self, sum: f64) -> f64 {
        sum / self.episodes.max(1) as f64
    }

    /// Mean return of the episodes that have ended; 0 without any.
    pub fn mean_return(&self) -> f64 {
        self.mean(self.returns)
    }

    /// Mean length in steps of the episodes that have ended; 0 without any.
    pub fn mean_length(&self) -> f64 {
        self.mean(self.lengths)
    }

    /// Means of the info columns over the episodes that have ended.
    pub fn mean_info(&self) -> impl Iterator<Item = f64> {
        self.info.iter().map(|sum| self.mean(*sum))
    }
}
