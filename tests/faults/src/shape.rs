//! What an engine serves, and the matching pools.

use endless_gym::{environments, memory_gym, popgym};
use endless_gym_core::batch::Frames;
use endless_gym_core::pool::{Autoreset, OptionMap, PoolConfig, ResetOptions, Seeding};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::PixelFormat;
use endless_gym_service::{EngineConfig, Namespace};
use serde::{Deserialize, Serialize};

use crate::options;

/// The engine's name in every round.
pub const SERVICE: &str = "gym";

/// What an engine serves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shape {
    /// The environments of one group. The engine's seed must not matter once the trainer has reset with seeds.
    pub pool: PoolConfig,
    pub groups: usize,
}

impl Shape {
    /// A random shape: any id and format, options within their limits, at most `most` environments in total.
    pub fn random(draws: &mut Generator, most: i64) -> Self {
        let suite = if draws.integers(0, 3) == 0 { popgym() } else { memory_gym() };
        let specs: Vec<_> = suite.specs().map(|spec| spec.id).collect();
        let id = *draws.choice(&specs);
        Shape::random_of(draws, id, most)
    }

    /// A random shape of an id.
    pub fn random_of(draws: &mut Generator, id: &str, most: i64) -> Self {
        let groups = draws.integers(1, 4);
        let autoreset =
            *draws.choice(&[Autoreset::NextStep, Autoreset::NextStep, Autoreset::SameStep, Autoreset::Disabled]);
        let mut flag = || draws.integers(0, 3) == 0;
        let format = PixelFormat { grayscale: flag(), channels_first: flag(), row_major: flag() };
        let (final_observation, features, has_seed, is_stacked, has_options) = (flag(), flag(), flag(), flag(), flag());
        let stack = if is_stacked { draws.integers(2, 5) as usize } else { 1 };
        // POPGym's observations are the features.
        let can_paint = environments().spec(id).is_ok_and(|spec| spec.frame.is_some());
        let options = if has_options { options::random(draws, id) } else { OptionMap::new() };
        let pool = PoolConfig::new(id, draws.integers(1, (most / groups).max(1) + 1) as usize)
            .options(ResetOptions::Shared(options))
            .autoreset(autoreset)
            .final_observation(final_observation && autoreset == Autoreset::SameStep)
            .frames((can_paint && draws.integers(0, 12) != 0).then_some(Frames { format, stack }))
            .features(features || !can_paint)
            .seeding(Seeding::Continue { seed: has_seed.then(|| draws.integers(0, 1000) as u64) });
        Shape { pool, groups: groups as usize }
    }

    /// The configuration of an engine that serves it.
    pub fn engine(&self, namespace: &Namespace) -> EngineConfig {
        EngineConfig::new(SERVICE, self.pool.clone(), 1).groups(self.groups).namespace(namespace.clone())
    }

    /// The pool that plays the same as the engine's group.
    pub fn group(&self, group: usize) -> PoolConfig {
        let num_envs = self.pool.num_envs;
        self.pool.clone().first_env(group * num_envs).total_envs(self.groups * num_envs)
    }
}
