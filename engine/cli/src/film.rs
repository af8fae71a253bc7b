//! An episode of a scripted expert, frame by frame.

use endless_gym_core::batch::{Batch, Block, Frames, zeroed};
use endless_gym_core::envs::view::VIEW_BYTES;
use endless_gym_core::pool::{Experts, Pool, PoolConfig, ResetRequest, Threads};
use endless_gym_core::raster::PixelFormat;

use super::failure::Failure;

/// One environment that its scripted expert plays.
pub struct Film {
    pool: Pool,
    blocks: Vec<Block>,
    expert: Experts,
    actions: Vec<i32>,
}

impl Film {
    /// Starts the first episode of the environment that `config` describes.
    pub fn new(config: &PoolConfig) -> Result<Self, Failure> {
        let format = PixelFormat { row_major: true, ..PixelFormat::default() };
        let frames = Some(Frames { format, stack: 1 });
        let config = PoolConfig { num_envs: 1, total_envs: 1, features: true, frames, ..config.clone() };
        let mut pool = Pool::new(&config, &Threads::new(1)?)?;
        let mut blocks = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut blocks)?;
        let spec = pool.spec();
        let actions = vec![0; spec.action_space.branches().len()];
        Ok(Film { expert: Experts::new(spec, 1, config.autoreset), pool, blocks, actions })
    }

    fn batch(&self) -> Batch<'_> {
        Batch::new(self.pool.layout(), &self.blocks)
    }

    /// The observation, uint8 (84, 84, 3), indexed \[row\]\[column\]\[channel\].
    pub fn observation(&self) -> &[u8] {
        self.batch().observation()
    }

    /// The ground-truth view, uint8 (336, 336, 3), indexed \[row\]\[column\]\[channel\]. Each call shows the next picture of a
    /// clue, as the original's does; call it once a step.
    pub fn ground_truth_view(&mut self) -> Result<Vec<u8>, Failure> {
        let mut view = vec![0; VIEW_BYTES];
        self.pool.ground_truth_view(0, &mut view)?;
        Ok(view)
    }

    /// Plays one step, unless the episode has ended. Returns whether there was a step.
    pub fn step(&mut self) -> Result<bool, Failure> {
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        if batch.terminated()[0] == 1 {
            return Ok(false);
        }
        self.expert.act(&batch, &mut self.actions)?;
        self.pool.step(&self.actions, &mut self.blocks)?;
        Ok(true)
    }
}
