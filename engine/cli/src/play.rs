//! Players for the demo and the benchmark, and what came of their episodes.

use clap::ValueEnum;
use endless_gym_core::batch::Batch;
use endless_gym_core::envs::{EnvSpec, Expert, expert};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

/// How actions are chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Policy {
    /// A script that looks at the feature observation and remembers what it has to.
    Expert,
    /// Any action, each as likely as another.
    Random,
}

/// Chooses actions at random.
pub struct RandomPlayer {
    branches: Vec<i32>,
    random: SmallRng,
}

impl RandomPlayer {
    pub fn new(spec: &EnvSpec) -> Self {
        RandomPlayer { branches: spec.action_space.branches().to_vec(), random: SmallRng::seed_from_u64(0) }
    }

    pub fn act(&mut self, actions: &mut [i32]) {
        for action in actions.chunks_exact_mut(self.branches.len()) {
            for (number, choices) in action.iter_mut().zip(&self.branches) {
                *number = self.random.random_range(0..*choices);
            }
        }
    }
}

/// A group of environments' experts, under next-step auto-reset.
pub struct ExpertPlayer {
    experts: Vec<Box<dyn Expert>>,
    /// The last step ended the episode; the next one starts another.
    ended: Vec<bool>,
    features: usize,
    vector_observation: usize,
    branches: usize,
}

impl ExpertPlayer {
    pub fn new(spec: &EnvSpec, num_envs: usize) -> Self {
        ExpertPlayer {
            experts: (0..num_envs).map(|_| expert(spec)).collect(),
            ended: vec![true; num_envs],
            features: spec.features.len(),
            vector_observation: spec.vector_observation,
            branches: spec.action_space.branches().len(),
        }
    }

    pub fn act(&mut self, batch: &Batch<'_>, actions: &mut [i32]) {
        let (features, vectors) = (batch.features(), batch.vector_observation());
        let terminated = batch.terminated();
        let rows = self.experts.iter_mut().zip(&mut self.ended).zip(actions.chunks_exact_mut(self.branches));
        for (env, ((expert, ended), action)) in rows.enumerate() {
            if std::mem::replace(ended, terminated[env] == 1) {
                expert.reset();
            }
            let vector = &vectors[env * self.vector_observation..][..self.vector_observation];
            expert.act(&features[env * self.features..][..self.features], vector, action);
        }
    }
}

/// Sums over the episodes that ended.
#[derive(Clone, Debug)]
pub struct Tally {
    pub steps: u64,
    pub episodes: u64,
    returns: f64,
    lengths: f64,
    info: Vec<f64>,
    /// Mean return so far of the episodes that ran when a batch was last added.
    pub running_return: f64,
}

impl Tally {
    pub fn new(spec: &EnvSpec) -> Self {
        Tally {
            steps: 0,
            episodes: 0,
            returns: 0.0,
            lengths: 0.0,
            info: vec![0.0; spec.info.len()],
            running_return: 0.0,
        }
    }

    pub fn add(&mut self, batch: &Batch<'_>) {
        let terminated = batch.terminated();
        self.steps += terminated.len() as u64;
        self.running_return = batch.episode_return().iter().sum::<f64>() / terminated.len() as f64;
        let info = batch.info();
        for env in (0..terminated.len()).filter(|env| terminated[*env] == 1) {
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

    pub fn mean_return(&self) -> f64 {
        self.mean(self.returns)
    }

    pub fn mean_length(&self) -> f64 {
        self.mean(self.lengths)
    }

    /// Means of the final info's columns.
    pub fn mean_info(&self) -> impl Iterator<Item = f64> {
        self.info.iter().map(|sum| self.mean(*sum))
    }
}
