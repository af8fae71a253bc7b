//! Random actions, drawn before the clock starts, since drawing them takes about as long as a step.

use endless_gym::envs::EnvSpec;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

/// Steps after which the actions repeat, in other states.
const STEPS: usize = 251;

/// The actions of all environments, step after step.
pub struct Actions {
    steps: Vec<Vec<i32>>,
    step: usize,
}

impl Actions {
    pub fn new(spec: &EnvSpec, num_envs: usize) -> Self {
        let branches = spec.action_space.branches();
        let mut random = SmallRng::seed_from_u64(1);
        let mut draw = |choices: &i32| random.random_range(0..*choices);
        let mut step = || (0..num_envs).flat_map(|_| branches).map(&mut draw).collect();
        Actions { steps: (0..STEPS).map(|_| step()).collect(), step: 0 }
    }

    pub fn next(&mut self) -> &[i32] {
        self.step = (self.step + 1) % STEPS;
        &self.steps[self.step]
    }
}
