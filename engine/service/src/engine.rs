//! The engine's side: takes actions, steps the pools, and has them write into shared memory.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use iceoryx2::port::ReceiveError;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::sample::Sample;
use serde_json::{Map, Value as Json};

use super::config::{Namespace, check_name};
use super::error::{PACKAGE_VERSION, Rejection, ServiceError};
use super::message::{ActionHeader, Kind, ObservationHeader, PayloadBlock};
use super::node::{Ipc, Member};
use super::ports::{self, ActionSubscriber, Limits, Names, ObservationPublisher, Open, PortError, Services};
use super::preflight::Resident;
use super::specification::{self, Published, Specification};
use super::wait::wait;
use endless_gym_core::batch::{Block, LAYOUT_VERSION, Layout, SNAPSHOT_BYTES, action_layout, blocks_for};
use endless_gym_core::pool::{Options, Pool, PoolConfig, PoolError, ResetRequest, Threads};

/// Most groups that an engine serves.
pub const MAX_GROUPS: usize = 64;

/// Most batches that a trainer may hold, and most observers.
const MAX_HELD: usize = 16;
const MAX_OBSERVERS: usize = 16;

/// Longest sleep of an engine that has nothing to do, and with it the longest time until it sees that it is to stop.
const IDLE: Duration = Duration::from_millis(100);

/// How often an engine that has nothing to do looks for dead processes.
const CLEANUP_EVERY: Duration = Duration::from_millis(500);

/// What an engine serves, and under which name.
#[derive(Clone, Debug)]
pub struct EngineConfig {
    /// The engine's name: 1 to 64 letters, digits, `.`, `_` or `-`.
    pub service: String,
    pub namespace: Namespace,
    /// The environments of one group. `first_env` and `total_envs` are counted over the groups by the engine; options for each
    /// environment are those of all groups, one after the other.
    pub pool: PoolConfig,
    /// Groups of environments, each stepped when its actions come, so that a trainer can work on one group while the engine
    /// steps another.
    pub groups: usize,
    /// Threads that all groups share.
    pub threads: Threads,
    /// Batches of a group that a trainer may hold at a time, 1 to 16. Memory for two more is taken at the start.
    pub batches_held: usize,
    /// Observers that may watch at a time, up to 16. They take no memory as long as they are not there.
    pub observers: usize,
}

impl EngineConfig {
    /// One group under the name `service`, in the default namespace, with room for three held batches and three observers.
    pub fn new(service: &str, pool: PoolConfig, threads: Threads) -> Self {
        EngineConfig {
            service: service.to_owned(),
            namespace: Namespace::default(),
            pool,
            groups: 1,
            threads,
            batches_held: 3,
            observers: 3,
        }
    }

    fn check(&self) -> Result<(), ServiceError> {
        check_name(&self.service)?;
        if !(1..=MAX_GROUPS).contains(&self.groups) {
            return Err(ServiceError::Groups { given: self.groups, limit: MAX_GROUPS });
        }
        let limits =
            [("batches to hold", self.batches_held, 1, MAX_HELD), ("observers", self.observers, 0, MAX_OBSERVERS)];
        for (what, given, lowest, highest) in limits {
            if !(lowest..=highest).contains(&given) {
                return Err(ServiceError::Limit { what, given, lowest, highest });
            }
        }
        Ok(())
    }

    /// The configurations of all groups' pools.
    fn pools(&self) -> Result<Vec<PoolConfig>, PoolError> {
        let num_envs = self.pool.num_envs;
        let total_envs = num_envs.saturating_mul(self.groups);
        (0..self.groups)
            .map(|group| {
                let first_env = group.saturating_mul(num_envs);
                let options = match &self.pool.options {
                    Options::Shared(options) => Options::Shared(options.clone()),
                    Options::Each(each) if each.len() == total_envs => {
                        Options::Each(each[first_env..first_env + num_envs].to_vec())
                    }
                    Options::Each(each) => {
                        return Err(PoolError::OptionsCount { given: each.len(), num_envs: total_envs });
                    }
                };
                Ok(PoolConfig { options, first_env, total_envs, ..self.pool.clone() })
            })
            .collect()
    }
}

/// What an engine did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Summary {
    /// Batches sent, those of resets included.
    pub batches: u64,
    /// Steps of single environments.
    pub env_steps: u64,
    /// Messages that were answered with a rejection.
    pub rejected: u64,
    /// Messages of an earlier epoch, which were dropped.
    pub dropped: u64,
    /// Batches that nobody was there to receive.
    pub undelivered: u64,
}

/// Chunks of a group that are in memory from the start: one is written while the trainer reads the other. More come into use,
/// and take memory, where a trainer or an observer holds more; [`Engine::new`] has made sure that there is room for them.
const CHUNKS_AT_START: usize = 2;

/// Environments behind a name, ready to be stepped by a trainer.
pub struct Engine {
    // Ports go before the node that they belong to.
    groups: Vec<Group>,
    to_trainer: Notifier<Ipc>,
    to_engine: Listener<Ipc>,
    specification: Specification,
    summary: Summary,
    _published: Published,
    node: Member,
}

struct Group {
    pool: Pool,
    actions: ActionSubscriber,
    observations: ObservationPublisher,
    memory: Resident,
    /// What the current message holds, copied so that nobody can change it after it was checked.
    action: Vec<i32>,
    reset: Vec<u8>,
    seed: Vec<u64>,
    snapshot: Vec<u8>,
    options: Option<Map<String, Json>>,
    /// The trainer that last reset all environments.
    trainer: Option<u64>,
    step: u64,
}

/// What a message is answered with.
enum Answer {
    Batch { env_steps: usize },
    Snapshot { bytes: usize },
}

impl Engine {
    /// Makes the environments and takes the name. Trainers can connect once [`run`](Engine::run) is called.
    pub fn new(config: &EngineConfig) -> Result<Self, ServiceError> {
        config.check()?;
        let node = Member::join(&config.namespace)?;
        specification::refuse_second_engine(&node, &config.service)?;
        let pools: Vec<Pool> =
            config.pools()?.iter().map(|pool| Pool::new(pool, &config.threads)).collect::<Result<_, _>>()?;
        let specification = specify(config, &pools[0]);
        let limits = specification.limits();
        let blocks = chunk_blocks(&specification.batch);
        Resident::check_available(blocks, limits.resident() * config.groups)?;
        let names = Names::new(&config.service, specification.epoch);
        let services = Services { node: &node, names, open: Open::Create };
        let to_engine = ports::listener(&services.events("to_engine", config.groups)?)?;
        let to_trainer = ports::notifier(&services.events("to_trainer", config.groups)?)?;
        let groups = pools
            .into_iter()
            .enumerate()
            .map(|(group, pool)| Group::new(&services, group, pool, limits))
            .collect::<Result<_, _>>()?;
        // Last, since whoever finds the specification must find everything else.
        let published = specification::publish(&node, &specification)?;
        let summary = Summary::default();
        Ok(Engine { groups, to_trainer, to_engine, specification, summary, _published: published, node })
    }

    /// What trainers read.
    pub fn specification(&self) -> &Specification {
        &self.specification
    }

    /// Serves until `stop` is set, which takes effect within a tenth of a second.
    pub fn run(&mut self, stop: &AtomicBool) -> Result<Summary, ServiceError> {
        let (mut answered, mut cleaned) = (Instant::now(), Instant::now());
        let mut next = 0;
        while !stop.load(Ordering::Relaxed) {
            let Engine { groups, to_engine, .. } = self;
            // Groups take turns in being looked at first, so that none starves.
            let message = wait(to_engine, IDLE, answered, || {
                let (first, last) = groups.split_at(next);
                let in_turn = last.iter().zip(next..).chain(first.iter().zip(0..));
                for (group, number) in in_turn {
                    if let Some(sample) = group.poll()? {
                        return Ok(Some((number, sample)));
                    }
                }
                Ok(None)
            })?;
            match message {
                Some((group, sample)) => {
                    next = (group + 1) % self.groups.len();
                    self.answer(group, sample)?;
                    answered = Instant::now();
                }
                None if cleaned.elapsed() >= CLEANUP_EVERY => {
                    self.node.clean();
                    cleaned = Instant::now();
                }
                None => {}
            }
        }
        Ok(self.summary)
    }

    fn answer(&mut self, number: usize, sample: Sample<Ipc, [PayloadBlock], ActionHeader>) -> Result<(), ServiceError> {
        let request = *sample.user_header();
        if request.layout_version == LAYOUT_VERSION && request.epoch != self.specification.epoch {
            tracing::debug!(group = number, "dropped a message of an earlier epoch");
            self.summary.dropped += 1;
            return Ok(());
        }
        let group = &mut self.groups[number];
        let taken = group.take(&self.specification.action, &request, bytemuck::cast_slice(sample.payload()));
        // The chunk goes back to the trainer before the step and not after it.
        drop(sample);
        let mut batch = group
            .observations
            .loan_slice_uninit(chunk_blocks(&self.specification.batch))
            .map_err(|e| ServiceError::middleware("cannot lend a batch")(e.to_string()))?;
        group.memory.admit(batch.payload_mut())?;
        // SAFETY: blocks are plain bytes, valid whatever they are, and the memory is initialised: the operating system zeroes
        // fresh shared memory, and what a recycled chunk held before is a batch.
        let mut batch = unsafe { batch.assume_init() };
        let outcome =
            taken.and_then(|kind| group.carry_out(kind, &request, bytemuck::cast_slice_mut(batch.payload_mut())));
        let step = group.step + u64::from(matches!(outcome, Ok(Answer::Batch { .. })));
        let header = batch.user_header_mut();
        *header = ObservationHeader::answering(&request, number, self.specification.epoch, step);
        match &outcome {
            Ok(Answer::Batch { .. }) => {}
            Ok(Answer::Snapshot { bytes }) => header.hold_snapshot(*bytes),
            Err((reason, message)) => header.reject(*reason, message),
        }
        // A trainer that dies just now must not take the engine with it.
        let receivers = batch.send().unwrap_or_else(|e| {
            tracing::warn!(error = %e, group = number, "a batch reaches nobody");
            0
        });
        ports::notify(&self.to_trainer, number);
        group.step = step;
        match outcome {
            Ok(Answer::Batch { env_steps }) => {
                self.summary.undelivered += u64::from(receivers == 0);
                self.summary.batches += 1;
                self.summary.env_steps += env_steps as u64;
            }
            Ok(Answer::Snapshot { .. }) => {}
            Err(_) => self.summary.rejected += 1,
        }
        Ok(())
    }
}

impl Group {
    fn new(services: &Services<'_>, number: usize, pool: Pool, limits: Limits) -> Result<Self, ServiceError> {
        let actions = services
            .actions(number)?
            .subscriber_builder()
            .create()
            .map_err(|e| ServiceError::middleware("cannot create a subscriber")(e.to_string()))?;
        let service = services.observations(number, limits)?;
        let publisher = ports::publisher(&service, chunk_blocks(pool.layout()), CHUNKS_AT_START);
        let (observations, memory) = publisher.map_err(|e| match e {
            PortError::Other(e) => e,
            PortError::Taken => ServiceError::middleware("cannot create a publisher")("it exists already".to_owned()),
        })?;
        Ok(Group {
            pool,
            actions,
            observations,
            memory,
            action: Vec::new(),
            reset: Vec::new(),
            seed: Vec::new(),
            snapshot: Vec::new(),
            options: None,
            trainer: None,
            step: 0,
        })
    }

    fn poll(&self) -> Result<Option<Sample<Ipc, [PayloadBlock], ActionHeader>>, ServiceError> {
        match self.actions.receive() {
            // A trainer that died while it connected.
            Err(ReceiveError::ConnectionFailure(e)) => {
                tracing::warn!(error = %e, "a trainer cannot be heard");
                Ok(None)
            }
            received => received.map_err(|e| ServiceError::middleware("cannot receive actions")(e.to_string())),
        }
    }

    /// Checks a message and copies what it holds.
    fn take(&mut self, layout: &Layout, header: &ActionHeader, payload: &[Block]) -> Result<Kind, (Rejection, String)> {
        if header.layout_version != LAYOUT_VERSION {
            let text = format!("it is of layout version {}, the engine's is {LAYOUT_VERSION}", header.layout_version);
            return Err((Rejection::Version, text));
        }
        let Some(kind) = Kind::from_code(header.kind) else {
            return Err((Rejection::Kind, format!("there is no kind {} of messages", header.kind)));
        };
        if payload.len() < layout.blocks() {
            let text = format!("it has {} blocks of 64 bytes, and needs {}", payload.len(), layout.blocks());
            return Err((Rejection::Payload, text));
        }
        match kind {
            Kind::Step => copy(&mut self.action, layout.read(payload, "action")),
            Kind::ResetEach => {
                copy(&mut self.reset, layout.read(payload, "reset"));
                copy(&mut self.seed, layout.read(payload, "seed"));
            }
            Kind::Restore => copy(&mut self.snapshot, start(layout.read(payload, "snapshot"), header.bytes)),
            Kind::ResetAll | Kind::ResetSeed | Kind::Snapshot => {}
        }
        self.options = match kind {
            Kind::ResetAll | Kind::ResetSeed | Kind::ResetEach if header.bytes > 0 => {
                let options = serde_json::from_slice(start(layout.read(payload, "options"), header.bytes));
                Some(options.map_err(|e| (Rejection::Options, format!("its reset parameters cannot be read: {e}")))?)
            }
            _ => None,
        };
        let starts_all = match kind {
            Kind::Step | Kind::Snapshot | Kind::Restore => false,
            Kind::ResetEach => !self.reset.contains(&0),
            Kind::ResetAll | Kind::ResetSeed => true,
        };
        if !starts_all && self.trainer != Some(header.trainer) {
            let text = "the environments are in episodes of another trainer or none; reset all of them first";
            return Err((Rejection::NotReset, text.to_owned()));
        }
        Ok(kind)
    }

    /// Does what the message asks for, and writes the answer into `payload`.
    fn carry_out(
        &mut self,
        kind: Kind,
        header: &ActionHeader,
        payload: &mut [Block],
    ) -> Result<Answer, (Rejection, String)> {
        let (options, env) = (self.options.as_ref(), header.env as usize);
        let batch_blocks = self.pool.layout().blocks();
        let batch = &mut payload[..batch_blocks];
        let done = match kind {
            Kind::Step => self.pool.step(&self.action, batch),
            Kind::Snapshot => return self.answer_snapshot(env, payload),
            Kind::Restore => {
                let done = self.pool.restore(env, &self.snapshot).map(|()| Answer::Snapshot { bytes: 0 });
                return done.map_err(|e| (Rejection::Snapshot, e.to_string()));
            }
            Kind::ResetAll => self.pool.reset_with(ResetRequest::All, options, batch),
            Kind::ResetSeed => self.pool.reset_with(ResetRequest::Seed(header.seed), options, batch),
            Kind::ResetEach => {
                let request = ResetRequest::Each { reset: &self.reset, seed: &self.seed };
                self.pool.reset_with(request, options, batch)
            }
        };
        done.map_err(|e| (Rejection::Pool, e.to_string()))?;
        self.trainer = Some(header.trainer);
        Ok(Answer::Batch { env_steps: if kind == Kind::Step { self.pool.layout().num_envs() } else { 0 } })
    }

    /// Writes an environment's snapshot over whatever batch was in `payload`.
    fn answer_snapshot(&self, env: usize, payload: &mut [Block]) -> Result<Answer, (Rejection, String)> {
        let snapshot = self.pool.snapshot(env).map_err(|e| (Rejection::Snapshot, e.to_string()))?;
        if snapshot.len() > SNAPSHOT_BYTES {
            let given = snapshot.len();
            let text = format!(
                "the snapshot has {given} bytes, a message takes {SNAPSHOT_BYTES}; its reset parameters have long lists, shorten them"
            );
            return Err((Rejection::Snapshot, text));
        }
        self.pool.layout().forget_frames(payload);
        bytemuck::cast_slice_mut(payload)[..snapshot.len()].copy_from_slice(&snapshot);
        Ok(Answer::Snapshot { bytes: snapshot.len() })
    }
}

/// Blocks of a chunk that can hold a batch as well as a snapshot.
fn chunk_blocks(batch: &Layout) -> usize {
    batch.blocks().max(blocks_for(SNAPSHOT_BYTES))
}

/// The first `length` numbers, or none where there are not as many.
fn start<T>(numbers: &[T], length: u64) -> &[T] {
    usize::try_from(length).ok().and_then(|length| numbers.get(..length)).unwrap_or_default()
}

fn copy<T: Copy>(to: &mut Vec<T>, from: &[T]) {
    to.clear();
    to.extend_from_slice(from);
}

fn specify(config: &EngineConfig, pool: &Pool) -> Specification {
    let spec = pool.spec();
    let features: &[_] = if config.pool.features { spec.features } else { &[] };
    Specification {
        service: config.service.clone(),
        layout_version: LAYOUT_VERSION,
        engine_version: PACKAGE_VERSION.to_owned(),
        engine_pid: std::process::id(),
        epoch: rand::random(),
        id: spec.id.to_owned(),
        groups: config.groups,
        num_envs: config.pool.num_envs,
        batch: pool.layout().clone(),
        action: action_layout(spec, config.pool.num_envs),
        frames: config.pool.frames,
        action_space: spec.action_space.into(),
        info: spec.info.iter().map(|column| column.name.to_owned()).collect(),
        features: features.iter().map(|column| column.name.to_owned()).collect(),
        options: match &config.pool.options {
            Options::Shared(options) => vec![options.clone()],
            Options::Each(each) => each.clone(),
        },
        autoreset: config.pool.autoreset,
        render_fps: spec.render_fps,
        batches_held: config.batches_held,
        observers: config.observers,
    }
}
