//! Compares an engine's group with a pool in this process that plays the same requests.

use std::collections::VecDeque;

use endless_gym::environments;
use endless_gym_core::batch::{BatchSection, Block, Layout, Section, zeroed};
use endless_gym_core::envs::ActionSpace;
use endless_gym_core::pool::{EnvReset, OptionMap, Pool, PoolError, ResetRequest, SnapshotError, Threads};
use endless_gym_core::random::Generator;
use endless_gym_service::{BatchLease, ServiceError, ServiceSpecification, Trainer};

use crate::options;
use crate::shape::Shape;

/// A request to a group. The group's twin plays it when the answer arrives.
#[derive(Clone, Debug)]
pub enum Request {
    Seed { seed: u64, options: Option<OptionMap> },
    Each { each: Vec<EnvReset>, options: Option<OptionMap> },
    Step(Vec<i32>),
}

impl Request {
    /// A random request to a group that has been reset.
    pub fn random(draws: &mut Generator, shape: &Shape, space: &ActionSpace, with_options: bool) -> Self {
        let num_envs = shape.pool.num_envs;
        if draws.integers(0, 40) == 0 {
            // An unseeded episode depends on earlier ones, so each environment is reset with a seed or not at all.
            let mut item = || match draws.integers(0, 2) {
                0 => EnvReset::Keep,
                _ => EnvReset::Seed(draws.integers(0, 1 << 32) as u64),
            };
            let each = (0..num_envs).map(|_| item()).collect();
            let options = (with_options && draws.integers(0, 2) == 0).then(|| options::random(draws, &shape.pool.id));
            return Request::Each { each, options };
        }
        Request::Step((0..num_envs).flat_map(|_| space.sample(draws)).collect())
    }

    /// Sends it.
    pub fn send(&self, trainer: &mut Trainer, group: usize) -> Result<(), ServiceError> {
        match self {
            Request::Seed { seed, options } => trainer.reset_with(group, ResetRequest::Seed(*seed), options.as_ref()),
            Request::Each { each, options } => trainer.reset_with(group, ResetRequest::Each(each), options.as_ref()),
            Request::Step(actions) => trainer.send(group, actions),
        }
    }
}

/// A pool that plays the same as a group.
pub struct Twin {
    pool: Pool,
    /// Several buffers used in turn, as in the engine.
    buffers: VecDeque<Vec<Block>>,
    /// Whether frames and snapshots may depend on what was played before a reset.
    shows_history: bool,
    /// Whether its state equals the engine's in every detail. An environment may keep hidden details across a reset.
    is_exact: bool,
}

impl Twin {
    pub fn new(shape: &Shape, group: usize) -> Result<Self, PoolError> {
        let pool = Pool::new(environments(), &shape.group(group), &Threads::new(1)?)?;
        let buffers = (0..3).map(|_| zeroed(pool.layout().blocks())).collect();
        let shows_history =
            shape.pool.id.contains("SearingSpotlights") || shape.pool.id.contains("Endless-MortarMayhem");
        Ok(Twin { pool, buffers, shows_history, is_exact: true })
    }

    /// The difference between an engine's specification and the expected one, if any.
    pub fn difference(&self, shape: &Shape, specification: &ServiceSpecification) -> Option<String> {
        let space = environments().spec(&shape.pool.id).map(|spec| &spec.action_space).ok();
        let same = specification.batch == *self.pool.layout()
            && Some(&specification.action_space) == space
            && specification.autoreset == shape.pool.autoreset;
        (!same).then(|| format!("specification {specification:?} is not that of {shape:?}"))
    }

    /// Plays a request and compares the engine's answer. Returns the first difference.
    pub fn compare(&mut self, request: &Request, lease: &BatchLease) -> Result<Option<String>, PoolError> {
        let buffer = self.play(request)?;
        let found = difference(self.pool.layout(), &buffer, bytemuck::cast_slice(lease.blocks()), false);
        self.buffers.push_back(buffer);
        Ok(found)
    }

    /// Like [`compare`](Twin::compare), for the first reset of an engine that has played before. What an episode shows
    /// of earlier ones, as in the original, is taken from the engine's snapshots; everything else must be as after the
    /// first reset of a new pool.
    pub fn adopt(
        &mut self,
        request: &Request,
        lease: &BatchLease,
        mut snapshot: impl FnMut(usize) -> Result<Vec<u8>, ServiceError>,
    ) -> Result<Result<Option<String>, PoolError>, ServiceError> {
        let given = bytemuck::cast_slice(lease.blocks());
        let new = self.play(request).map(|buffer| difference(self.pool.layout(), &buffer, given, self.shows_history));
        self.is_exact = self.shows_history;
        if !self.shows_history || !matches!(new, Ok(None)) {
            return Ok(new);
        }
        for env in 0..self.pool.layout().num_envs() {
            let taken = snapshot(env)?;
            if let Err(error) = self.pool.restore(env, &taken) {
                return Ok(Ok(Some(format!("the snapshot of environment {env} is refused: {error}"))));
            }
        }
        let mut shown = zeroed(self.pool.layout().blocks());
        Ok(self.pool.observe(&mut shown).map(|()| difference(self.pool.layout(), &shown, given, false)))
    }

    /// Takes a snapshot of an environment and restores it, which repeats its last frame in a stack. Returns whether the
    /// snapshot equals `given`.
    pub fn snapshot(&mut self, env: usize, given: &[u8]) -> Result<bool, SnapshotError> {
        let snapshot = self.pool.snapshot(env)?;
        self.pool.restore(env, &snapshot)?;
        Ok(snapshot == given || !self.is_exact)
    }

    fn play(&mut self, request: &Request) -> Result<Vec<Block>, PoolError> {
        let mut buffer = self.buffers.pop_front().unwrap_or_else(|| zeroed(self.pool.layout().blocks()));
        match request {
            Request::Seed { seed, options } => {
                self.pool.reset_with(ResetRequest::Seed(*seed), options.as_ref(), &mut buffer)
            }
            Request::Each { each, options } => {
                self.pool.reset_with(ResetRequest::Each(each), options.as_ref(), &mut buffer)
            }
            Request::Step(actions) => self.pool.step(actions, &mut buffer),
        }?;
        Ok(buffer)
    }
}

/// The first section that differs; with `only_numbers`, sections that describe the frame are skipped. Padding is not
/// compared, since it may hold a rejection's text.
fn difference(layout: &Layout, expected: &[Block], given: &[u8], only_numbers: bool) -> Option<String> {
    let expected: &[u8] = bytemuck::cast_slice(expected);
    let ended = layout.section(BatchSection::Terminated).map_or(0, Section::offset);
    let is_frame = |section: &Section| matches!(section.name(), BatchSection::Observation | BatchSection::Features);
    layout.sections().iter().filter(|section| !(only_numbers && is_frame(section))).find_map(|section| {
        let row = section.bytes() / layout.num_envs();
        let is_final = section.name().to_string().starts_with("final_");
        (0..layout.num_envs()).find_map(|env| {
            let start = section.offset() + env * row;
            let (expected_row, given_row) = (expected.get(start..start + row)?, given.get(start..start + row)?);
            // Rows of episodes that have not ended are unspecified in these sections.
            let is_specified = !is_final || expected.get(ended + env) != Some(&0);
            (is_specified && expected_row != given_row).then(|| {
                let count = expected_row.iter().zip(given_row).filter(|(expected, given)| expected != given).count();
                format!("section {} of environment {env} differs in {count} of {row} bytes", section.name())
            })
        })
    })
}

/// A checksum of all sections of a batch.
pub fn checksum(lease: &BatchLease) -> u32 {
    let mut sum = crc32fast::Hasher::new();
    let bytes: &[u8] = bytemuck::cast_slice(lease.blocks());
    for section in lease.specification().batch.sections() {
        sum.update(bytes.get(section.offset()..section.offset() + section.bytes()).unwrap_or_default());
    }
    sum.finalize()
}
