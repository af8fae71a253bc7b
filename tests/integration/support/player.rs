//! Pools in this process.

use endless_gym::batch::{Batch, Block, zeroed};
use endless_gym::envs::EnvSpec;
use endless_gym::memory_gym;
use endless_gym::pool::{Pool, PoolConfig, Registry, ResetRequest, Threads};
use rand::RngExt;
use rand::rngs::SmallRng;

/// A pool with the memory for its batch.
pub struct Player {
    pub pool: Pool,
    pub blocks: Vec<Block>,
}

impl Player {
    /// A pool that has not been reset, with one thread.
    pub fn new(config: &PoolConfig) -> Self {
        Player::in_registry(memory_gym(), config, 1)
    }

    pub fn in_registry(registry: &Registry, config: &PoolConfig, threads: usize) -> Self {
        let pool = Pool::new(registry, config, &Threads::new(threads).unwrap()).unwrap();
        let blocks = zeroed(pool.layout().blocks());
        Player { pool, blocks }
    }

    /// A pool whose environments have been reset.
    pub fn started(config: &PoolConfig) -> Self {
        let mut player = Player::new(config);
        player.reset(ResetRequest::All);
        player
    }

    pub fn reset(&mut self, request: ResetRequest<'_>) {
        self.pool.reset(request, &mut self.blocks).unwrap();
    }

    pub fn step(&mut self, actions: &[i32]) {
        self.pool.step(actions, &mut self.blocks).unwrap();
    }

    /// Steps with the same number in all branches of all environments.
    pub fn step_all(&mut self, number: i32) {
        let count = self.pool.layout().num_envs() * self.pool.spec().action_space.width();
        self.step(&vec![number; count]);
    }

    pub fn step_at_random(&mut self, random: &mut SmallRng) {
        let actions = random_actions(self.pool.spec(), self.pool.layout().num_envs(), random);
        self.step(&actions);
    }

    /// Writes the current observations.
    pub fn observe(&mut self) {
        self.pool.observe(&mut self.blocks).unwrap();
    }

    pub fn batch(&self) -> Batch<'_> {
        Batch::new(self.pool.layout(), &self.blocks)
    }

    /// Every byte of the batch.
    pub fn bytes(&self) -> &[u8] {
        self.batch().bytes()
    }
}

/// Uniformly random actions of `num_envs` environments.
pub fn random_actions(spec: &EnvSpec, num_envs: usize, random: &mut SmallRng) -> Vec<i32> {
    let branches = spec.action_space.branches();
    (0..num_envs).flat_map(|_| branches).map(|choices| random.random_range(0..*choices)).collect()
}
