//! One environment that a person plays.

use endless_gym_core::batch::{Batch, Block, Frames, zeroed};
use endless_gym_core::envs::EnvSpec;
use endless_gym_core::pool::{
    Autoreset, OptionMap, Pool, PoolConfig, Registry, ResetOptions, ResetRequest, Seeding, Threads,
};
use endless_gym_core::raster::FrameShape;

use super::frame::newest;
use super::picture::Pixels;
use crate::failure::Failure;

/// An episode of a new environment, so that it depends only on its options, its seed and the actions.
pub struct Game {
    registry: Registry,
    pool: Pool,
    blocks: Vec<Block>,
    options: OptionMap,
    pub seed: u64,
}

impl Game {
    /// Starts an episode.
    pub fn start(registry: &Registry, id: &str, options: OptionMap, seed: u64) -> Result<Self, Failure> {
        let config = PoolConfig::new(id, 1)
            .options(ResetOptions::Shared(options.clone()))
            .autoreset(Autoreset::Disabled)
            .frames(None)
            .seeding(Seeding::Continue { seed: Some(seed) });
        let mut pool = Pool::new(registry, &config, &Threads::new(1)?)?;
        let mut blocks = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut blocks)?;
        Ok(Game { registry: registry.clone(), pool, blocks, options, seed })
    }

    /// Starts another episode with the same or another seed.
    pub fn restart(&mut self, seed: u64) -> Result<(), Failure> {
        *self = Game::start(&self.registry, self.spec().id, self.options.clone(), seed)?;
        Ok(())
    }

    pub fn spec(&self) -> &EnvSpec {
        self.pool.spec()
    }

    fn batch(&self) -> Batch<'_> {
        Batch::new(self.pool.layout(), &self.blocks)
    }

    /// Whether the episode has ended.
    pub fn is_over(&self) -> bool {
        self.batch().has_ended(0)
    }

    /// Plays one step, unless the episode has ended.
    pub fn step(&mut self, action: &[i32]) -> Result<(), Failure> {
        if !self.is_over() {
            self.pool.step(action, &mut self.blocks)?;
        }
        Ok(())
    }

    /// What the agent sees; black without a picture.
    pub fn frame(&self) -> Pixels {
        let drawn = self.pool.frame(0).unwrap_or_else(|_| vec![0; 3]);
        newest(&drawn, Frames::default(), self.spec().shown().unwrap_or(FrameShape::rgb(1, 1)))
    }

    /// What the agent sees of an environment without a picture.
    pub fn features(&self) -> String {
        self.spec().text(self.batch().features())
    }

    /// Seed, steps and rewards.
    pub fn numbers(&self) -> String {
        let batch = self.batch();
        let (length, reward, total) = (batch.episode_length()[0], batch.reward()[0], batch.episode_return()[0]);
        format!("{}  seed {}  step {length}  reward {reward:.3}  return {total:.3}", self.spec().id, self.seed)
    }

    /// The progress of the episode, and at its end its final infos.
    pub fn progress(&self) -> Result<String, Failure> {
        let counted = self.pool.progress(0)?.into_iter().map(|progress| match progress.of {
            Some(of) => format!("{} {} of {of}", progress.name, progress.value),
            None => format!("{} {}", progress.name, progress.value),
        });
        let batch = self.batch();
        let info = self.spec().info.iter().zip(batch.info());
        let info = info.map(|(column, value)| format!("{} {value:.3}", column.name.replace('_', " ")));
        let parts: Vec<String> = counted.chain(info.filter(|_| self.is_over())).collect();
        Ok(parts.join("  "))
    }

    /// The commands in the vector observation of Memory Gym's `MortarMayhemB`, decoded from its one-hot codes; empty for other ids.
    pub fn commands(&self) -> String {
        if !self.spec().id.starts_with("MortarMayhemB") {
            return String::new();
        }
        const ARROWS: [&str; 9] = ["⊗", "→", "←", "↑", "↓", "↘", "↗", "↙", "↖"];
        let places = self.batch().vector_observation().chunks_exact(ARROWS.len());
        let arrows =
            places.filter_map(|places| places.iter().position(|place| *place == 1.0)).map(|place| ARROWS[place]);
        arrows.collect::<Vec<_>>().join(" ")
    }
}
