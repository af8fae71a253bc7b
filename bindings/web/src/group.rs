//! Self-playing environments of one id.

use endless_gym_core::batch::{Batch, Block, zeroed};
use endless_gym_core::pool::{Experts, OptionMap, Pool, PoolConfig, ResetOptions, ResetRequest, Seeding, Threads};
use endless_gym_core::random::Generator;
use endless_gym_memory_gym::{FRAME, memory_gym};
use serde_json::{Value as Json, json};

use crate::error::WebError;

enum Policy {
    Experts(Experts),
    Random(Generator),
}

pub struct Group {
    pool: Pool,
    blocks: Vec<Block>,
    policy: Policy,
    actions: Vec<i32>,
    episodes: u64,
    returns: f64,
    lengths: f64,
}

impl Group {
    pub fn new(id: &str, num_envs: usize, options: OptionMap, expert: bool, seed: u64) -> Result<Self, WebError> {
        let config = PoolConfig {
            options: ResetOptions::Shared(options),
            seeding: Seeding::Continue { seed: Some(seed) },
            features: expert,
            ..PoolConfig::new(id, num_envs)
        };
        let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1)?)?;
        let mut blocks = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut blocks)?;
        let spec = pool.spec();
        let policy = match expert {
            true => Policy::Experts(Experts::new(memory_gym(), id, num_envs, config.autoreset)?),
            false => Policy::Random(Generator::from_seed(seed)),
        };
        let actions = vec![0; num_envs * spec.action_space.width()];
        Ok(Group { pool, blocks, policy, actions, episodes: 0, returns: 0.0, lengths: 0.0 })
    }

    /// Steps every environment. The step after an episode's end starts the next one.
    pub fn step(&mut self) -> Result<(), WebError> {
        let branches = self.pool.spec().action_space.branches();
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        match &mut self.policy {
            Policy::Random(random) => {
                for row in self.actions.chunks_exact_mut(branches.len()) {
                    for (number, choices) in row.iter_mut().zip(branches) {
                        *number = random.integers(0, i64::from(*choices)) as i32;
                    }
                }
            }
            Policy::Experts(experts) => experts.act(&batch, &mut self.actions)?,
        }
        self.pool.step(&self.actions, &mut self.blocks)?;
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        for env in (0..batch.terminated().len()).filter(|env| batch.terminated()[*env] == 1) {
            self.episodes += 1;
            self.returns += batch.episode_return()[env];
            self.lengths += f64::from(batch.episode_length()[env]);
        }
        Ok(())
    }

    /// The observations, one after the other.
    pub fn observations(&self) -> impl Iterator<Item = &[u8]> {
        Batch::new(self.pool.layout(), &self.blocks).observation().chunks_exact(FRAME.bytes())
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
