//! Self-playing environments of one id.

use endless_gym_core::batch::{Batch, Block, zeroed};
use endless_gym_core::pool::{
    Experts, OptionMap, Pool, PoolConfig, Registry, ResetOptions, ResetRequest, RunningEpisode, Seeding, Threads,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::FrameShape;
use serde_json::{Value as Json, json};

use crate::error::WebError;
use crate::game::texts;

/// The seeds of the episodes are below this; those of the paper's training.
const SEEDS: u64 = 100_000;

enum Policy {
    Experts(Experts),
    Random(Generator),
}

pub struct Group {
    shape: FrameShape,
    pool: Pool,
    blocks: Vec<Block>,
    /// Pictures of environments without frames, one after the other.
    drawn: Vec<u8>,
    policy: Policy,
    actions: Vec<i32>,
    episodes: u64,
    returns: f64,
    lengths: f64,
}

impl Group {
    /// Environments that their experts play, or random actions.
    pub fn new(
        registry: &Registry,
        id: &str,
        num_envs: usize,
        options: OptionMap,
        expert: bool,
        seed: u64,
    ) -> Result<Self, WebError> {
        let spec = registry.spec(id)?;
        let shape = spec.shown().ok_or(WebError::NoFrame { id: spec.id })?;
        // Each episode has its own seed, so that it can be played alone.
        let seeding = Seeding::Range { start: 0, end: SEEDS, step: 1, seed: Some(seed) };
        let options = ResetOptions::Shared(options);
        let config = PoolConfig::new(id, num_envs).options(options).seeding(seeding).features(expert);
        let mut pool = Pool::new(registry, &config, &Threads::new(1)?)?;
        let mut blocks = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut blocks)?;
        let policy = match expert {
            true => Policy::Experts(Experts::new(registry, id, num_envs, config.autoreset)?),
            false => Policy::Random(Generator::from_seed(seed)),
        };
        let actions = vec![0; num_envs * spec.action_space.width()];
        let mut group =
            Group { shape, pool, blocks, drawn: Vec::new(), policy, actions, episodes: 0, returns: 0.0, lengths: 0.0 };
        group.draw()?;
        Ok(group)
    }

    /// Steps every environment. The step after an episode's end starts the next one.
    pub fn step(&mut self) -> Result<(), WebError> {
        let space = &self.pool.spec().action_space;
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        match &mut self.policy {
            Policy::Random(random) => {
                for action in self.actions.chunks_exact_mut(space.width()) {
                    action.copy_from_slice(&space.sample(random));
                }
            }
            Policy::Experts(experts) => experts.act(&batch, &mut self.actions)?,
        }
        self.pool.step(&self.actions, &mut self.blocks)?;
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        for env in (0..batch.layout().num_envs()).filter(|env| batch.has_ended(*env)) {
            self.episodes += 1;
            self.returns += batch.episode_return()[env];
            self.lengths += f64::from(batch.episode_length()[env]);
        }
        Ok(())
    }

    /// Draws the pictures of environments without frames.
    pub fn draw(&mut self) -> Result<(), WebError> {
        self.drawn.clear();
        if self.pool.spec().frame.is_none() {
            for env in 0..self.pool.layout().num_envs() {
                self.drawn.extend(self.pool.frame(env)?);
            }
        }
        Ok(())
    }

    /// The observations or pictures, one after the other, and their shape.
    pub fn observations(&self) -> impl Iterator<Item = (&[u8], FrameShape)> {
        let frames = Batch::new(self.pool.layout(), &self.blocks).observation();
        let observations = if frames.is_empty() { &self.drawn } else { frames };
        observations.chunks_exact(self.shape.bytes()).map(|observation| (observation, self.shape))
    }

    /// The episode that an environment plays.
    pub fn episode(&self, env: usize) -> Result<Json, WebError> {
        let RunningEpisode { seed, options, .. } = self.pool.running_episode(env)?;
        Ok(json!({
            "id": self.pool.spec().id,
            "seed": seed.map(|seed| seed.to_string()),
            "options": texts(&options),
        }))
    }

    pub fn shape(&self) -> FrameShape {
        self.shape
    }

    /// Episodes so far, and the means of their returns and lengths.
    pub fn state(&self) -> Json {
        let mean = |sum: f64| (self.episodes > 0).then(|| sum / self.episodes as f64);
        json!({
            "id": self.pool.spec().id,
            "num_envs": self.pool.layout().num_envs(),
            "episodes": self.episodes,
            "mean_return": mean(self.returns),
            "mean_length": mean(self.lengths),
        })
    }
}
