//! Many environments of one id, stepped in lockstep by the calling thread and workers.

mod buffers;
mod history;
mod lanes;
mod seeding;
mod shown;
mod snapshot;
mod threads;

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;

use serde_json::{Map, Value as Json};
use thiserror::Error;

use crate::batch::{BatchMut, Block, Contents, Frames, Layout, MAX_STACK, batch_layout};
use crate::envs::mortar_mayhem::MortarMayhem;
use crate::envs::mystery_path::MysteryPath;
use crate::envs::searing_spotlights::SearingSpotlights;
use crate::envs::view::VIEW_BYTES;
use crate::envs::{self, EnvSpec, Environment, Family, ParameterError, ResetParameters, UnknownEnvironment};
use crate::random::EntropyError;
use crate::raster::PixelFormat;
use buffers::Buffers;
use lanes::{FamilyLanes, Lanes, Work};
pub use seeding::Seeding;
use seeding::{Seeds, Unseeded};
use shown::Drawing;
pub use shown::WrongFrame;
pub use snapshot::{SNAPSHOT_VERSION, SnapshotError};
pub use threads::Threads;

/// Most environments in one pool.
pub const MAX_ENVS: usize = 1 << 20;

/// When an episode that ended gives way to the next one. The names are Gymnasium's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Autoreset {
    /// In the step after: that step ignores its action, and returns the new episode's first observation with a reward of 0.
    #[default]
    NextStep,
    /// In the same step: the observation is already the new episode's, reward, flags and info are the old one's.
    SameStep,
    /// Never: the trainer resets with [`Pool::reset`]. Until then the episode is played on, as the original allows.
    Disabled,
}

/// Reset parameters of a pool's environments, by the original's names.
#[derive(Clone, Debug, PartialEq)]
pub enum Options {
    /// All environments have the same.
    Shared(Map<String, Json>),
    /// One set for each environment.
    Each(Vec<Map<String, Json>>),
}

impl Default for Options {
    fn default() -> Self {
        Options::Shared(Map::new())
    }
}

/// What a pool is made of.
#[derive(Clone, Debug)]
pub struct PoolConfig {
    /// Environment id, such as `MortarMayhem-v0`.
    pub id: String,
    /// Environments in the pool, 1 to [`MAX_ENVS`].
    pub num_envs: usize,
    pub options: Options,
    pub autoreset: Autoreset,
    /// Whether same-step auto-reset keeps the last observation of an episode, in the `final_*` sections.
    pub final_observation: bool,
    pub seeding: Seeding,
    /// What the frames in the batch look like; without them nothing is drawn.
    pub frames: Option<Frames>,
    /// Whether the batch has the feature observation.
    pub features: bool,
    /// Whether every frame is drawn a second time, in full, and compared: a difference is [`PoolError::WrongFrame`]. For tests.
    pub check_drawing: bool,
    /// Number of this pool's first environment, and of environments in all pools together, for seeding: an engine that serves
    /// several groups counts its environments through.
    pub first_env: usize,
    pub total_envs: usize,
}

impl PoolConfig {
    /// `num_envs` environments of that id with the defaults: default options, next-step auto-reset, seeds from entropy.
    pub fn new(id: &str, num_envs: usize) -> Self {
        PoolConfig {
            id: id.to_owned(),
            num_envs,
            options: Options::default(),
            autoreset: Autoreset::default(),
            final_observation: false,
            seeding: Seeding::Continue { seed: None },
            frames: Some(Frames::default()),
            features: false,
            check_drawing: false,
            first_env: 0,
            total_envs: num_envs,
        }
    }
}

/// Which environments start an episode.
#[derive(Clone, Copy, Debug)]
pub enum ResetRequest<'a> {
    /// All, each with the seed that the seeding policy gives it.
    All,
    /// All; environment `i` of the pool is seeded with `seed + first_env + i` (wrapping), where `first_env` is
    /// [`PoolConfig::first_env`].
    Seed(u64),
    /// Each as its number says: 0 leaves it alone, 1 starts an episode by the seeding policy, 2 one with its own `seed`.
    Each { reset: &'a [u8], seed: &'a [u64] },
}

impl ResetRequest<'_> {
    /// Whether environment number `env` starts an episode.
    fn resets(&self, env: usize) -> bool {
        match self {
            ResetRequest::All | ResetRequest::Seed(_) => true,
            ResetRequest::Each { reset, .. } => reset[env] != 0,
        }
    }
}

/// Environments of one id in lockstep.
pub struct Pool {
    spec: &'static EnvSpec,
    layout: Layout,
    lanes: Box<dyn Lanes>,
    buffers: Buffers,
    format: PixelFormat,
    check_drawing: bool,
    autoreset: Autoreset,
    threads: Threads,
    first_env: usize,
    was_reset: bool,
}

impl Pool {
    /// Makes the environments. They want a [`reset`](Pool::reset) before the first step.
    pub fn new(config: &PoolConfig, threads: &Threads) -> Result<Self, PoolError> {
        let spec = envs::spec(&config.id)?;
        if !(1..=MAX_ENVS).contains(&config.num_envs) {
            return Err(PoolError::NumEnvs { given: config.num_envs });
        }
        if let Some(Frames { stack: given, .. }) = config.frames
            && !(1..=MAX_STACK).contains(&given)
        {
            return Err(PoolError::Stack { given });
        }
        match &config.seeding {
            Seeding::List(seeds) if seeds.is_empty() => return Err(PoolError::NoSeeds),
            Seeding::Range { start, end, .. } if start >= end || *end > i64::MAX as u64 => {
                return Err(PoolError::SeedRange { start: *start, end: *end });
            }
            _ => {}
        }
        let unseeded = Unseeded::draw(&config.seeding)?;
        let lanes: Box<dyn Lanes> = match spec.family {
            Family::MortarMayhem(variant) => Box::new(family_lanes::<MortarMayhem>(spec, variant, config, unseeded)?),
            Family::MysteryPath(variant) => Box::new(family_lanes::<MysteryPath>(spec, variant, config, unseeded)?),
            Family::SearingSpotlights(variant) => {
                Box::new(family_lanes::<SearingSpotlights>(spec, variant, config, unseeded)?)
            }
        };
        Ok(Pool {
            spec,
            layout: batch_layout(
                spec,
                config.num_envs,
                Contents {
                    frames: config.frames,
                    features: config.features,
                    final_observation: config.final_observation && config.autoreset == Autoreset::SameStep,
                },
            ),
            lanes,
            buffers: Buffers::new(unseeded.identity()),
            format: config.frames.unwrap_or_default().format,
            check_drawing: config.check_drawing,
            autoreset: config.autoreset,
            threads: threads.clone(),
            first_env: config.first_env,
            was_reset: false,
        })
    }

    /// What is fixed about the environment id.
    pub fn spec(&self) -> &'static EnvSpec {
        self.spec
    }

    /// How a batch of this pool lies in memory.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Starts episodes and writes every environment's row: the current observation, a reward of 0, no flag.
    pub fn reset(&mut self, request: ResetRequest<'_>, batch: &mut [Block]) -> Result<(), PoolError> {
        self.reset_with(request, None, batch)
    }

    /// As [`reset`](Pool::reset), with other reset parameters: the environments that start an episode play it and all later ones
    /// with `options`, by the original's names, and the defaults for the rest. `None` leaves each environment its own. On an error
    /// no environment has moved.
    pub fn reset_with(
        &mut self,
        request: ResetRequest<'_>,
        options: Option<&Map<String, Json>>,
        batch: &mut [Block],
    ) -> Result<(), PoolError> {
        let num_envs = self.layout.num_envs();
        let request = match request {
            ResetRequest::Seed(seed) => ResetRequest::Seed(seed.wrapping_add(self.first_env as u64)),
            other => other,
        };
        match request {
            ResetRequest::Each { reset, seed } if reset.len() != num_envs || seed.len() != num_envs => {
                return Err(PoolError::ResetCount { given: reset.len().min(seed.len()), num_envs });
            }
            ResetRequest::Each { reset, .. } if !self.was_reset && reset.contains(&0) => {
                return Err(PoolError::NotReset);
            }
            _ => {}
        }
        if let Some(options) = options {
            // Not before all else has been checked, so that on an error nothing has moved.
            let (given, needed) = (batch.len(), self.layout.blocks());
            if given < needed {
                return Err(PoolError::BatchTooShort { given, needed });
            }
            self.lanes.set_options(request, options)?;
        }
        self.write(batch, |lanes, work, out| lanes.reset(work, request, out))?;
        self.was_reset = true;
        Ok(())
    }

    /// Plays one step of every environment. `actions` holds a row of int32 for each environment, one number for each branch of
    /// the action space. On an error no environment has moved.
    pub fn step(&mut self, actions: &[i32], batch: &mut [Block]) -> Result<(), PoolError> {
        if !self.was_reset {
            return Err(PoolError::NotReset);
        }
        check_actions(self.spec, self.layout.num_envs(), actions)?;
        let autoreset = self.autoreset;
        self.write(batch, |lanes, work, out| lanes.step(work, autoreset, actions, out))
    }

    /// Has a batch written.
    fn write(
        &mut self,
        batch: &mut [Block],
        write: impl FnOnce(&mut dyn Lanes, Work<'_>, BatchMut<'_>) -> Result<(), WrongFrame>,
    ) -> Result<(), PoolError> {
        let (given, needed) = (batch.len(), self.layout.blocks());
        if given < needed {
            return Err(PoolError::BatchTooShort { given, needed });
        }
        let buffer = self.buffers.begin(&self.layout, batch);
        let drawing = Drawing { known: buffer.known, format: self.format, check: self.check_drawing };
        let work = Work { threads: &self.threads, slot: buffer.slot, drawing };
        let out = BatchMut::new(&self.layout, batch).ok_or(PoolError::BatchTooShort { given, needed })?;
        write(&mut *self.lanes, work, out)?;
        self.buffers.finish(buffer, &self.layout, batch);
        Ok(())
    }

    /// Writes every environment's row as a reset of none does: the current observation, a reward of 0, no flag.
    pub fn observe(&mut self, batch: &mut [Block]) -> Result<(), PoolError> {
        let num_envs = self.layout.num_envs();
        self.reset(ResetRequest::Each { reset: &vec![0; num_envs], seed: &vec![0; num_envs] }, batch)
    }

    /// The whole state of one environment, its generator included, for [`restore`](Pool::restore).
    pub fn snapshot(&self, env: usize) -> Result<Vec<u8>, SnapshotError> {
        self.check_env(env)?;
        if self.was_reset { self.lanes.snapshot(env) } else { Err(SnapshotError::NotReset) }
    }

    /// Puts an environment of the same id into the state that a snapshot was taken in, also one of another pool, with other
    /// reset parameters: it goes on identically. [`observe`](Pool::observe) shows what it looks like.
    ///
    /// The seeds of later episodes are the snapshot's too where both pools have the same kind of [`Seeding`]. An observation of
    /// several frames shows the snapshot's as if it was the episode's first.
    pub fn restore(&mut self, env: usize, snapshot: &[u8]) -> Result<(), SnapshotError> {
        self.check_env(env)?;
        self.lanes.restore(env, snapshot)
    }

    fn check_env(&self, env: usize) -> Result<(), SnapshotError> {
        let num_envs = self.layout.num_envs();
        if env < num_envs { Ok(()) } else { Err(SnapshotError::NoSuchEnvironment { given: env, num_envs }) }
    }

    /// Draws the ground-truth view of one environment: what the original's `render()` returns in the mode `debug_rgb_array`,
    /// indexed \[row\]\[column\]\[channel\]. `out` holds [`VIEW_BYTES`] bytes.
    pub fn ground_truth_view(&mut self, env: usize, out: &mut [u8]) -> Result<(), PoolError> {
        let num_envs = self.layout.num_envs();
        match () {
            _ if !self.was_reset => return Err(PoolError::NotReset),
            _ if env >= num_envs => return Err(PoolError::NoSuchEnv { env, num_envs }),
            _ if out.len() != VIEW_BYTES => return Err(PoolError::ViewSize { given: out.len() }),
            _ => self.lanes.ground_truth_view(env, out),
        }
        Ok(())
    }
}

/// Whether `actions` fit `num_envs` environments: the right count, each in its branch's range.
pub fn check_actions(spec: &EnvSpec, num_envs: usize, actions: &[i32]) -> Result<(), PoolError> {
    let branches = spec.action_space.branches();
    if actions.len() != num_envs * branches.len() {
        return Err(PoolError::ActionCount { given: actions.len(), num_envs, branches: branches.len() });
    }
    let fits = |action: &[i32]| action.iter().zip(branches).all(|(a, n)| (0..*n).contains(a));
    match actions.chunks_exact(branches.len()).position(|action| !fits(action)) {
        None => Ok(()),
        Some(env) => Err(PoolError::ActionRange {
            env,
            given: actions[env * branches.len()..][..branches.len()].to_vec(),
            space: spec.action_space.to_string(),
        }),
    }
}

/// Makes the environments of one family; those with the same options share their assets.
fn family_lanes<E: Environment>(
    spec: &'static EnvSpec,
    variant: E::Variant,
    config: &PoolConfig,
    unseeded: Unseeded,
) -> Result<FamilyLanes<E>, PoolError> {
    // The options of an environment, and what is made from them.
    let make = |given: &Map<String, Json>| -> Result<(Arc<lanes::Options>, Arc<E::Assets>), ParameterError> {
        let parameters = ResetParameters::new(spec.id, spec.parameters, given)?;
        Ok((Arc::new(given.clone()), Arc::new(E::assets(variant, &parameters))))
    };
    let made: Vec<_> = match &config.options {
        Options::Shared(given) => vec![make(given)?; config.num_envs],
        Options::Each(each) if each.len() == config.num_envs => {
            let mut known = HashMap::new();
            each.iter()
                .enumerate()
                .map(|(env, given)| match known.entry(Json::from(given.clone()).to_string()) {
                    Entry::Occupied(entry) => Ok(Clone::clone(entry.get())),
                    Entry::Vacant(entry) => make(given)
                        .map(|made| Clone::clone(entry.insert(made)))
                        .map_err(|source| PoolError::ParametersOf { env, source }),
                })
                .collect::<Result<_, _>>()?
        }
        Options::Each(each) => {
            return Err(PoolError::OptionsCount { given: each.len(), num_envs: config.num_envs });
        }
    };
    let list: Arc<[u64]> = match &config.seeding {
        Seeding::List(seeds) => seeds.as_slice().into(),
        _ => [].into(),
    };
    let environments = made.into_iter().enumerate().map(|(env, (options, assets))| {
        let number = config.first_env + env;
        let seeds = Seeds::new(&config.seeding, &list, number, config.total_envs, unseeded);
        (assets, options, seeds, unseeded.environment(number))
    });
    let stack = config.frames.unwrap_or_default().stack;
    Ok(FamilyLanes::new(spec, variant, stack, environments))
}

/// A pool that cannot be made, or a call that it cannot carry out.
#[derive(Debug, Error)]
pub enum PoolError {
    #[error(transparent)]
    UnknownEnvironment(#[from] UnknownEnvironment),
    #[error(transparent)]
    Parameters(#[from] ParameterError),
    #[error(transparent)]
    Entropy(#[from] EntropyError),
    #[error("options of environment {env}: {source}")]
    ParametersOf { env: usize, source: ParameterError },
    #[error("{given} sets of options for {num_envs} environments; give one for each, or one for all")]
    OptionsCount { given: usize, num_envs: usize },
    #[error("{given} environments asked for; a pool has 1 to {MAX_ENVS}")]
    NumEnvs { given: usize },
    #[error("a stack of {given} frames asked for; an observation has 1 to {MAX_STACK}")]
    Stack { given: usize },
    #[error("the list of seeds is empty; give at least one")]
    NoSeeds,
    #[error("the range of seeds {start}..{end} is empty or ends above 2^63 - 1")]
    SeedRange { start: u64, end: u64 },
    #[error("cannot start {count} threads: {source}")]
    Threads { count: usize, source: std::io::Error },
    #[error("step before the first reset; reset all environments once")]
    NotReset,
    #[error("{given} action numbers for {num_envs} environments of {branches} branches; give {}", num_envs * branches)]
    ActionCount { given: usize, num_envs: usize, branches: usize },
    #[error("action {given:?} of environment {env} is not in {space}")]
    ActionRange { env: usize, given: Vec<i32>, space: String },
    #[error("a reset of {given} environments asked of a pool of {num_envs}; give one flag and one seed for each")]
    ResetCount { given: usize, num_envs: usize },
    #[error("no environment {env} in a pool of {num_envs}")]
    NoSuchEnv { env: usize, num_envs: usize },
    #[error("{given} bytes given for a ground-truth view; it has {VIEW_BYTES}")]
    ViewSize { given: usize },
    #[error(transparent)]
    WrongFrame(#[from] WrongFrame),
    #[error("a batch of {given} blocks of 64 bytes given; the layout needs {needed}")]
    BatchTooShort { given: usize, needed: usize },
}
