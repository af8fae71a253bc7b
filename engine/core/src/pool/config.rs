//! Configuration of a pool, and reset requests.

use serde_json::{Map, Value as Json};

use super::autoreset::Autoreset;
use super::error::PoolError;
use super::seeding::{MAX_TOTAL_ENVS, Seeding};
use crate::batch::limits::MAX_ENVS;
use crate::batch::{Contents, Frames, MAX_STACK, batch_layout};
use crate::envs::{self, ResetParameters};

/// Reset parameters by the original's names, as a JSON object.
pub type OptionMap = Map<String, Json>;

/// Reset parameters of a pool's environments. Omitted parameters have the original's defaults.
#[derive(Clone, Debug, PartialEq)]
pub enum ResetOptions {
    /// The same for all environments.
    Shared(OptionMap),
    /// One set for each environment.
    Each(Vec<OptionMap>),
}

impl Default for ResetOptions {
    fn default() -> Self {
        ResetOptions::Shared(OptionMap::new())
    }
}

/// Configuration of a pool.
#[derive(Clone, Debug)]
pub struct PoolConfig {
    /// Environment id, such as `MortarMayhem-v0`.
    pub id: String,
    /// Number of environments in the pool, 1 to [`MAX_ENVS`].
    pub num_envs: usize,
    /// Reset parameters.
    pub options: ResetOptions,
    /// When the next episode starts after one has ended.
    pub autoreset: Autoreset,
    /// Whether same-step autoreset keeps the last observation of an episode, in the `final_*` sections. Without effect in other
    /// modes.
    pub final_observation: bool,
    /// Source of the episodes' seeds.
    pub seeding: Seeding,
    /// Whether an episode depends on its seed and its reset parameters alone. Otherwise, as in the original, some environments show
    /// what an earlier episode left (the character of Endless Mortar Mayhem, the lit circles and the background of Searing
    /// Spotlights), and with [`Seeding::Continue`] an episode continues the generator that the one before has drawn from. With this,
    /// every episode starts as in a new environment, and [`Seeding::Continue`] draws a seed for each later episode: from
    /// `SeedSequence(seed, spawn_key=(0,))`, where `seed` is the one that the environment was last given. Resets allocate memory.
    pub independent_episodes: bool,
    /// Format of the frames; `None` omits them, and nothing is drawn.
    pub frames: Option<Frames>,
    /// Whether the batch has the feature observation.
    pub features: bool,
    /// Whether the batch says which parts of the frames have changed since the pool's batch before, for readers that keep a copy
    /// ([`ObservationCopy`](crate::batch::ObservationCopy)). Without effect without frames.
    pub changes: bool,
    /// Whether every frame is drawn a second time, in full, and compared; a difference is [`PoolError::WrongFrame`]. For tests.
    pub check_drawing: bool,
    /// Number of this pool's first environment among all environments, for [`seeding`](Self::seeding) and [`ResetRequest::Seed`]:
    /// an engine that serves several groups numbers the environments of all groups consecutively.
    pub first_env: usize,
    /// Number of environments in all pools together, for [`seeding`](Self::seeding): `first_env + num_envs` to 2^32 - 1.
    pub total_envs: usize,
}

impl PoolConfig {
    /// `num_envs` environments of that id with the defaults: default reset parameters, next-step autoreset, seeds from entropy,
    /// frames as the original's.
    pub fn new(id: &str, num_envs: usize) -> Self {
        PoolConfig {
            id: id.to_owned(),
            num_envs,
            options: ResetOptions::default(),
            autoreset: Autoreset::default(),
            final_observation: false,
            seeding: Seeding::Continue { seed: None },
            independent_episodes: false,
            frames: Some(Frames::default()),
            features: false,
            changes: false,
            check_drawing: false,
            first_env: 0,
            total_envs: num_envs,
        }
    }

    /// Checks everything, as [`Pool::new`](super::Pool::new) does, without making environments.
    ///
    /// # Errors
    ///
    /// [`PoolError`] if the id is unknown, or a reset parameter or a number is out of its range.
    pub fn validate(&self) -> Result<(), PoolError> {
        let spec = envs::spec(&self.id)?;
        self.check()?;
        batch_layout(spec, self.num_envs, self.contents())?;
        let check = |given: &OptionMap| ResetParameters::new(spec.id, spec.parameters, given).map(drop);
        match &self.options {
            ResetOptions::Shared(given) => Ok(check(given)?),
            ResetOptions::Each(each) => each.iter().enumerate().try_for_each(|(env, given)| {
                check(given).map_err(|source| PoolError::ParametersOf { env: self.first_env + env, source })
            }),
        }
    }

    /// Checks all but the id and the reset parameters.
    pub(super) fn check(&self) -> Result<(), PoolError> {
        if !(1..=MAX_ENVS).contains(&self.num_envs) {
            return Err(PoolError::NumEnvs { given: self.num_envs });
        }
        if let Some(Frames { stack: given, .. }) = self.frames
            && !(1..=MAX_STACK).contains(&given)
        {
            return Err(PoolError::Stack { given });
        }
        let end = self.first_env.checked_add(self.num_envs);
        if end.is_none_or(|end| end > self.total_envs) || self.total_envs > MAX_TOTAL_ENVS {
            let PoolConfig { first_env, num_envs, total_envs, .. } = *self;
            return Err(PoolError::EnvNumbers { first_env, num_envs, total_envs });
        }
        if let ResetOptions::Each(each) = &self.options
            && each.len() != self.num_envs
        {
            return Err(PoolError::OptionsCount { given: each.len(), num_envs: self.num_envs });
        }
        match &self.seeding {
            Seeding::List(seeds) if seeds.is_empty() => Err(PoolError::NoSeeds),
            Seeding::Range { start, end, .. } if start >= end || *end > i64::MAX as u64 => {
                Err(PoolError::SeedRange { start: *start, end: *end })
            }
            Seeding::Range { step: 0, .. } => Err(PoolError::SeedStep),
            _ => Ok(()),
        }
    }

    /// The optional sections of the pool's batch.
    pub(super) fn contents(&self) -> Contents {
        Contents {
            frames: self.frames,
            features: self.features,
            final_observation: self.final_observation && self.autoreset == Autoreset::SameStep,
            changes: self.changes,
        }
    }
}

/// Which environments start an episode.
#[derive(Clone, Copy, Debug)]
pub enum ResetRequest<'a> {
    /// All, each with the next seed of [`Seeding`].
    All,
    /// All; environment `i` of the pool is seeded with `seed + first_env + i` (wrapping), where `first_env` is
    /// [`PoolConfig::first_env`].
    Seed(u64),
    /// Per environment, by `reset`.
    Each {
        /// For each environment: 0 does not reset it, 1 starts an episode with the next seed of [`Seeding`], 2 starts one with
        /// its item of `seed`. Other values count as 2.
        reset: &'a [u8],
        /// For each environment a seed, which is used where `reset` is 2.
        seed: &'a [u64],
    },
}

impl ResetRequest<'_> {
    /// Whether environment number `env` starts an episode.
    pub(super) fn resets(&self, env: usize) -> bool {
        match self {
            ResetRequest::All | ResetRequest::Seed(_) => true,
            ResetRequest::Each { reset, .. } => reset[env] != 0,
        }
    }
}
