//! What an engine serves: the arguments of `endless serve`, and the matching pools.

use endless_gym::{environments, memory_gym, popgym};
use endless_gym_core::batch::Frames;
use endless_gym_core::pool::{Autoreset, OptionMap, PoolConfig, ResetOptions, Seeding};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::PixelFormat;
use serde::{Deserialize, Serialize};

use crate::options;

/// The engine's name in every round.
pub const SERVICE: &str = "gym";

/// What an engine serves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shape {
    pub id: String,
    pub num_envs: usize,
    pub groups: usize,
    pub autoreset: Autoreset,
    pub final_observation: bool,
    pub features: bool,
    pub frames: Option<Frames>,
    pub options: OptionMap,
    /// The engine's seed, which must not matter once the trainer has reset with seeds.
    pub seed: Option<u64>,
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
        Shape {
            id: id.to_owned(),
            num_envs: draws.integers(1, (most / groups).max(1) + 1) as usize,
            groups: groups as usize,
            autoreset,
            final_observation: final_observation && autoreset == Autoreset::SameStep,
            features: features || !can_paint,
            frames: (can_paint && draws.integers(0, 12) != 0).then_some(Frames { format, stack }),
            options,
            seed: has_seed.then(|| draws.integers(0, 1000) as u64),
        }
    }

    /// The arguments of `endless` to serve it.
    pub fn arguments(&self) -> Vec<String> {
        let mut arguments = vec!["serve".to_owned(), format!("--service={SERVICE}"), "--child".to_owned()];
        arguments.push(format!("--env={}", self.id));
        arguments.push(format!("--num-envs={}", self.num_envs));
        arguments.push(format!("--groups={}", self.groups));
        arguments.push("--threads=1".to_owned());
        arguments.push(format!("--autoreset={}", self.autoreset.name()));
        arguments.extend(self.options.iter().map(|(name, value)| format!("--option={name}={value}")));
        arguments.extend(self.seed.map(|seed| format!("--seed={seed}")));
        let mut flag = |is_set: bool, name: &str| arguments.extend(is_set.then(|| name.to_owned()));
        flag(self.final_observation, "--final-observation");
        flag(self.features, "--features");
        match self.frames {
            None => flag(true, "--no-frames"),
            Some(Frames { format, stack }) => {
                flag(format.grayscale, "--grayscale");
                flag(format.channels_first, "--channels-first");
                flag(format.row_major, "--row-major");
                arguments.push(format!("--frame-stack={stack}"));
            }
        }
        arguments
    }

    /// The pool that plays the same as the engine's group.
    pub fn pool(&self, group: usize) -> PoolConfig {
        PoolConfig::new(&self.id, self.num_envs)
            .options(ResetOptions::Shared(self.options.clone()))
            .autoreset(self.autoreset)
            .final_observation(self.final_observation)
            .seeding(Seeding::Continue { seed: self.seed })
            .frames(self.frames)
            .features(self.features)
            .first_env(group * self.num_envs)
            .total_envs(self.groups * self.num_envs)
    }
}
