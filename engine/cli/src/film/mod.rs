//! An episode that a policy plays, frame by frame.

pub mod file;
pub mod picture;
pub mod webp;

use endless_gym_core::batch::{Batch, Block, zeroed};
use endless_gym_core::envs::view::{Picture, rgb_array};
use endless_gym_core::pool::{Experts, Pool, PoolConfig, PoolError, Registry, ResetRequest, Threads};

use crate::failure::Failure;
use crate::policies::{Policy, RandomPolicy};

/// The policy that plays.
enum Player {
    Expert(Experts),
    Random(RandomPolicy),
}

/// One environment that a policy plays.
pub struct Film {
    pool: Pool,
    blocks: Vec<Block>,
    player: Player,
    actions: Vec<i32>,
}

impl Film {
    /// Starts the first episode of the environment that `config` describes. `action_seed` seeds the random actions.
    pub fn new(registry: &Registry, config: &PoolConfig, policy: Policy, action_seed: u64) -> Result<Self, Failure> {
        let config = config.clone().num_envs(1).total_envs(1).features(true).frames(None);
        let mut pool = Pool::new(registry, &config, &Threads::new(1)?)?;
        let mut blocks = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut blocks)?;
        let spec = pool.spec();
        let actions = vec![0; spec.action_space.width()];
        let player = match policy {
            Policy::Expert => Player::Expert(Experts::new(registry, &config.id, 1, config.autoreset)?),
            Policy::Random => Player::Random(RandomPolicy::new(spec, action_seed)),
        };
        Ok(Film { player, pool, blocks, actions })
    }

    fn batch(&self) -> Batch<'_> {
        Batch::new(self.pool.layout(), &self.blocks)
    }

    /// The observation.
    pub fn observation(&self) -> Result<Picture, Failure> {
        let spec = self.pool.spec();
        let shape = spec.shown().ok_or(PoolError::NoFrame { id: spec.id })?;
        Ok(rgb_array(&self.pool.frame(0)?, shape))
    }

    /// The ground-truth view. Each call may show the next picture of an animation; call it once per step.
    pub fn ground_truth_view(&mut self) -> Result<Picture, Failure> {
        Ok(self.pool.ground_truth_view(0)?)
    }

    /// Return and length of the episode so far.
    pub fn episode(&self) -> (f64, i32) {
        (self.batch().episode_return()[0], self.batch().episode_length()[0])
    }

    /// Plays one step, unless the episode has ended. Returns whether there was a step.
    pub fn step(&mut self) -> Result<bool, Failure> {
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        if batch.has_ended(0) {
            return Ok(false);
        }
        match &mut self.player {
            Player::Expert(experts) => experts.act(&batch, &mut self.actions)?,
            Player::Random(random) => random.act(&mut self.actions),
        }
        self.pool.step(&self.actions, &mut self.blocks)?;
        Ok(true)
    }
}
