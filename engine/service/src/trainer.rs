//! The trainer's side: sends actions and receives batches, which it reads where the engine wrote them.

use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use serde_json::{Map, Value as Json};

use super::config::Namespace;
use super::error::ServiceError;
use super::here::Here;
use super::message::{ActionHeader, Kind};
use super::node::{Ipc, Member};
use super::ports::{self, ActionPublisher, CLEANUP_TIMEOUT, Names, Open, PortError, Services};
use super::received::{ObservationPort, Received};
use super::specification::{self, Specification};
use super::wait::wait;
use endless_gym_core::batch::{ActionSection, Block, LAYOUT_VERSION, OPTIONS_BYTES, SNAPSHOT_BYTES};
use endless_gym_core::pool::ResetRequest;

/// How long a trainer hears nothing before it looks whether the engine still lives.
const QUIET: Duration = Duration::from_millis(200);

/// How often a trainer looks for an engine that is not there yet.
const RETRY: Duration = Duration::from_millis(20);

/// Chunks of an action publisher: one that the engine reads, one on its way, one being written.
const ACTION_CHUNKS: usize = 3;

/// Where a trainer or an observer finds its engine.
#[derive(Clone, Debug)]
pub struct ConnectConfig {
    /// The engine's name.
    pub service: String,
    pub namespace: Namespace,
    /// How long to wait for an engine of that name to appear. Zero: it must be there.
    pub timeout: Duration,
}

impl ConnectConfig {
    /// The engine of that name in the default namespace, which must be there.
    pub fn new(service: &str) -> Self {
        ConnectConfig { service: service.to_owned(), namespace: Namespace::default(), timeout: Duration::ZERO }
    }
}

/// The one process that acts in an engine's environments.
///
/// Each [`reset`](Trainer::reset) or [`send`](Trainer::send) to a group is answered by one batch, which
/// [`receive`](Trainer::receive) returns; several groups may owe an answer at a time.
///
/// A trainer outlives its engine: after [`ServiceError::EngineLost`] or [`ServiceError::EngineRestarted`] it goes on with an
/// engine of the same name once [`reconnect`](Trainer::reconnect) succeeds. Batches that it still holds stay readable.
pub struct Trainer {
    config: ConnectConfig,
    specification: Arc<Specification>,
    link: Here<Link>,
    trainer: u64,
    request: u64,
    /// The message that each group has not answered yet.
    pending: Vec<Option<Pending>>,
    /// When the last message was sent.
    sent: Instant,
}

/// A message that is to be answered.
#[derive(Clone, Copy, Debug)]
struct Pending {
    request: u64,
    asked: Asked,
}

/// What a message asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Asked {
    kind: Kind,
    /// First seed of a [`Kind::ResetSeed`].
    seed: u64,
    /// Environment of a [`Kind::Snapshot`] or a [`Kind::Restore`].
    env: usize,
    /// Checksum of a [`Kind::Restore`]'s snapshot.
    snapshot: u32,
}

impl Asked {
    fn of(kind: Kind) -> Self {
        Asked { kind, seed: 0, env: 0, snapshot: 0 }
    }
}

/// Ports to one engine, for the time that it runs.
struct Link {
    actions: Vec<ActionPublisher>,
    observations: Vec<Arc<ObservationPort>>,
    to_engine: Notifier<Ipc>,
    to_trainer: Listener<Ipc>,
    engine: UniqueNodeId,
    node: Arc<Member>,
}

impl Trainer {
    /// Connects to an engine by its name. Waits for it as long as `config` says.
    pub fn connect(config: &ConnectConfig) -> Result<Self, ServiceError> {
        let (link, specification) = Link::new(config)?;
        let pending = vec![None; specification.groups];
        let specification = Arc::new(specification);
        let trainer = rand::random();
        let (config, link, sent) = (config.clone(), Here::new(link), Instant::now());
        Ok(Trainer { config, specification, link, trainer, request: 0, pending, sent })
    }

    /// Connects to an engine of the same name that was started in place of the one that is lost, waiting for it up to
    /// `timeout`. It must serve the same environments in the same layout, and wants a reset of each group. Where the engine is
    /// not lost, the connection stays. In both cases answers that are still due are forgotten.
    pub fn reconnect(&mut self, timeout: Duration) -> Result<(), ServiceError> {
        if !self.link.node.is_alive(self.link.engine) {
            let (link, specification) = Link::new(&ConnectConfig { timeout, ..self.config.clone() })?;
            if let Some(what) = self.specification.difference(&specification) {
                return Err(ServiceError::SpecificationChanged { service: self.config.service.clone(), what });
            }
            self.specification = Arc::new(specification);
            self.link = Here::new(link);
        }
        self.pending.fill(None);
        Ok(())
    }

    /// What the engine serves.
    pub fn specification(&self) -> &Specification {
        &self.specification
    }

    /// Asks a group to start episodes; [`receive`](Trainer::receive) returns their first observations.
    pub fn reset(&mut self, group: usize, request: ResetRequest<'_>) -> Result<(), ServiceError> {
        self.reset_with(group, request, None)
    }

    /// As [`reset`](Trainer::reset), with other reset parameters for the environments that start an episode, from then on; see
    /// [`Pool::reset_with`](endless_gym_core::pool::Pool::reset_with).
    pub fn reset_with(
        &mut self,
        group: usize,
        request: ResetRequest<'_>,
        options: Option<&Map<String, Json>>,
    ) -> Result<(), ServiceError> {
        let (specification, num_envs) = (Arc::clone(&self.specification), self.specification.num_envs);
        let options = options.map(|options| Json::from(options.clone()).to_string()).unwrap_or_default();
        if options.len() > OPTIONS_BYTES {
            return Err(ServiceError::OptionsTooLong { given: options.len() });
        }
        let write_options = |message: &mut [Block]| {
            let text = specification.action.write::<u8>(message, ActionSection::Options);
            text[..options.len()].copy_from_slice(options.as_bytes());
            Ok(options.len())
        };
        match request {
            ResetRequest::All => self.post(group, Asked::of(Kind::ResetAll), write_options),
            ResetRequest::Seed(seed) => self.post(group, Asked { seed, ..Asked::of(Kind::ResetSeed) }, write_options),
            ResetRequest::Each { reset, seed } if reset.len() != num_envs || seed.len() != num_envs => {
                let given = if reset.len() == num_envs { seed.len() } else { reset.len() };
                Err(ServiceError::ResetCount { given, num_envs })
            }
            ResetRequest::Each { reset, seed } => self.post(group, Asked::of(Kind::ResetEach), |message| {
                specification.action.write::<u8>(message, ActionSection::Reset).copy_from_slice(reset);
                specification.action.write::<u64>(message, ActionSection::Seed).copy_from_slice(seed);
                write_options(message)
            }),
        }
    }

    /// Steps a group; [`receive`](Trainer::receive) returns what came of it. `actions` holds a row for each environment, one
    /// number for each branch of the action space.
    pub fn send(&mut self, group: usize, actions: &[i32]) -> Result<(), ServiceError> {
        let specification = Arc::clone(&self.specification);
        specification.action_space.check(specification.num_envs, actions)?;
        self.post(group, Asked::of(Kind::Step), |message| {
            specification.action.write::<i32>(message, ActionSection::Action).copy_from_slice(actions);
            Ok(0)
        })
    }

    /// As [`Trainer::send`], for actions that `fill` writes where the engine reads them. Until then the slice holds an earlier
    /// step's actions or zeros.
    pub fn send_with(&mut self, group: usize, fill: impl FnOnce(&mut [i32])) -> Result<(), ServiceError> {
        let specification = Arc::clone(&self.specification);
        self.post(group, Asked::of(Kind::Step), |message| {
            let actions = specification.action.write::<i32>(message, ActionSection::Action);
            fill(actions);
            specification.action_space.check(specification.num_envs, actions)?;
            Ok(0)
        })
    }

    /// The answer to the last message to `group`.
    ///
    /// After [`ServiceError::TimedOut`] it is still due and may be received later. An engine that is slow is waited for; one
    /// that is dead is noticed within half a second.
    pub fn receive(&mut self, group: usize, timeout: Duration) -> Result<Received, ServiceError> {
        self.check_group(group)?;
        if !self.owes_batch(group) {
            return Err(ServiceError::NothingSent { group });
        }
        self.receive_from(group..group + 1, true, timeout)
    }

    /// The answer of whichever group has it first. [`Received::group`] tells which.
    pub fn receive_any(&mut self, timeout: Duration) -> Result<Received, ServiceError> {
        if !(0..self.pending.len()).any(|group| self.owes_batch(group)) {
            return Err(ServiceError::NothingSent { group: 0 });
        }
        self.receive_from(0..self.pending.len(), true, timeout)
    }

    /// The whole state of an environment of a group, for [`restore`](Trainer::restore) and
    /// [`Pool::restore`](endless_gym_core::pool::Pool::restore). The group must owe no answer, and must have been reset by this trainer.
    ///
    /// After [`ServiceError::TimedOut`] the same call goes on waiting, and any other takes its place; so for `restore`.
    pub fn snapshot(&mut self, group: usize, env: usize, timeout: Duration) -> Result<Vec<u8>, ServiceError> {
        self.ask(group, Asked { env, ..Asked::of(Kind::Snapshot) }, timeout, |_| Ok(0))
    }

    /// Puts an environment of a group into the state of a snapshot; see [`Pool::restore`](endless_gym_core::pool::Pool::restore). A reset of
    /// no environment ([`ResetRequest::Each`]) then shows what it looks like. After [`ServiceError::TimedOut`] the engine may still
    /// do it, before anything that it is asked for later.
    pub fn restore(
        &mut self,
        group: usize,
        env: usize,
        snapshot: &[u8],
        timeout: Duration,
    ) -> Result<(), ServiceError> {
        let given = snapshot.len();
        if given > SNAPSHOT_BYTES {
            return Err(ServiceError::SnapshotTooLong { given });
        }
        let specification = Arc::clone(&self.specification);
        let write = |message: &mut [Block]| {
            specification.action.write::<u8>(message, ActionSection::Snapshot)[..given].copy_from_slice(snapshot);
            Ok(given)
        };
        let asked = Asked { env, snapshot: crc32fast::hash(snapshot), ..Asked::of(Kind::Restore) };
        self.ask(group, asked, timeout, write).map(|_| ())
    }

    /// Posts a message that is not answered by a batch, unless it is already, and waits for the answer.
    fn ask(
        &mut self,
        group: usize,
        asked: Asked,
        timeout: Duration,
        write: impl FnOnce(&mut [Block]) -> Result<usize, ServiceError>,
    ) -> Result<Vec<u8>, ServiceError> {
        self.check_group(group)?;
        if self.pending[group].is_none_or(|pending| pending.asked != asked) {
            self.post(group, asked, write)?;
        }
        let received = self.receive_from(group..group + 1, false, timeout)?;
        let incompatible = || ServiceError::IncompatibleTypes { service: self.config.service.clone() };
        received.snapshot().map(<[u8]>::to_vec).ok_or_else(incompatible)
    }

    fn owes_batch(&self, group: usize) -> bool {
        self.pending[group].is_some_and(|pending| pending.asked.kind.yields_batch())
    }

    /// The first answer that one of `groups` owes, of those that are batches or of those that are not.
    fn receive_from(
        &mut self,
        groups: std::ops::Range<usize>,
        batches: bool,
        timeout: Duration,
    ) -> Result<Received, ServiceError> {
        let start = Instant::now();
        loop {
            let left = timeout.saturating_sub(start.elapsed());
            let (link, pending) = (&*self.link, &self.pending);
            let answer = wait(&link.to_trainer, left.min(QUIET), self.sent, || {
                for group in groups.clone() {
                    let due = pending[group].filter(|pending| pending.asked.kind.yields_batch() == batches);
                    let Some(Pending { request, .. }) = due else { continue };
                    // What is in the buffer may be the answer to an earlier trainer.
                    while let Some(received) = link.observations[group].receive(&self.specification)? {
                        if received.answers(self.trainer, request) {
                            return Ok(Some(received));
                        }
                    }
                }
                Ok(None)
            })?;
            if let Some(received) = answer {
                self.pending[received.group()] = None;
                return received.or_rejection();
            }
            if !link.node.is_alive(link.engine) {
                return Err(self.lost());
            }
            if start.elapsed() >= timeout {
                return Err(ServiceError::TimedOut { service: self.config.service.clone(), waited: timeout });
            }
        }
    }

    fn check_group(&self, group: usize) -> Result<(), ServiceError> {
        if group < self.pending.len() {
            return Ok(());
        }
        let (service, groups) = (self.config.service.clone(), self.pending.len());
        Err(ServiceError::NoSuchGroup { service, given: group, groups })
    }

    /// Writes a message in shared memory and sends it. `write` says how many bytes of options or of a snapshot it wrote.
    fn post(
        &mut self,
        group: usize,
        asked: Asked,
        write: impl FnOnce(&mut [Block]) -> Result<usize, ServiceError>,
    ) -> Result<(), ServiceError> {
        self.check_group(group)?;
        if self.owes_batch(group) {
            return Err(ServiceError::AnswerPending { group });
        }
        let failed = ServiceError::middleware("cannot send a message");
        let message = self.link.actions[group]
            .loan_slice_uninit(self.specification.action.blocks())
            .map_err(|e| failed(e.to_string()))?;
        // SAFETY: blocks are plain bytes, valid whatever they are, and the memory is initialised: the operating system zeroes
        // fresh shared memory, and what a recycled chunk held before is a message.
        let mut message = unsafe { message.assume_init() };
        let bytes = write(bytemuck::cast_slice_mut(message.payload_mut()))? as u64;
        self.request += 1;
        *message.user_header_mut() = ActionHeader {
            layout_version: LAYOUT_VERSION,
            kind: asked.kind.code(),
            epoch: self.specification.epoch,
            trainer: self.trainer,
            request: self.request,
            seed: asked.seed,
            env: asked.env as u64,
            bytes,
        };
        let receivers = message.send().map_err(|e| failed(e.to_string()))?;
        if receivers == 0 && !self.link.node.is_alive(self.link.engine) {
            return Err(self.lost());
        }
        ports::notify(&self.link.to_engine, group);
        self.pending[group] = Some(Pending { request: self.request, asked });
        self.sent = Instant::now();
        Ok(())
    }

    /// The error for an engine that does not live any more: whether another one has taken its place.
    fn lost(&self) -> ServiceError {
        let service = self.config.service.clone();
        match specification::read(&self.link.node, &service) {
            Ok(Some(other)) if other.epoch != self.specification.epoch => ServiceError::EngineRestarted { service },
            _ => ServiceError::EngineLost { service, pid: self.specification.engine_pid },
        }
    }
}

impl Link {
    fn new(config: &ConnectConfig) -> Result<(Self, Specification), ServiceError> {
        let (node, ports, specification) = find(config, |node, specification| {
            let names = Names::new(&specification.service, specification.epoch);
            let services = Services { node, names, open: Open::Existing };
            let groups = 0..specification.groups;
            // The publishers first: whoever has the first of them is the trainer.
            let actions: Vec<_> = groups
                .clone()
                .map(|group| action_publisher(&services, group, specification))
                .collect::<Result<_, _>>()?;
            let observations: Vec<_> = groups
                .map(|group| ObservationPort::open(&services, node, group, specification).map(Arc::new))
                .collect::<Result<_, _>>()?;
            let to_engine = ports::notifier(&services.events("to_engine", specification.groups)?)?;
            let to_trainer = ports::listener(&services.events("to_trainer", specification.groups)?)?;
            Ok((actions, observations, to_engine, to_trainer))
        })?;
        let (actions, observations, to_engine, to_trainer) = ports;
        let engine = observations[0].engine();
        Ok((Link { actions, observations, to_engine, to_trainer, engine, node }, specification))
    }
}

/// Looks for the engine until `connect` succeeds with what its specification says or time is up.
pub(super) fn find<T>(
    config: &ConnectConfig,
    connect: impl Fn(&Arc<Member>, &Specification) -> Result<T, ServiceError>,
) -> Result<(Arc<Member>, T, Specification), ServiceError> {
    let start = Instant::now();
    let node = Arc::new(Member::join(&config.namespace)?);
    loop {
        let result = match specification::read(&node, &config.service)? {
            None => Err(ServiceError::UnknownEngine {
                service: config.service.clone(),
                root: config.namespace.root().to_owned(),
                known: known(&specification::list(&node)?),
            }),
            Some(specification) => connect(&node, &specification).map(|ports| (ports, specification)),
        };
        match result {
            Ok((ports, specification)) => return Ok((node, ports, specification)),
            // The engine is not there yet, or was replaced while we connected.
            Err(ServiceError::UnknownEngine { .. } | ServiceError::EngineRestarted { .. })
                if start.elapsed() < config.timeout =>
            {
                node.clean();
                std::thread::sleep(RETRY);
            }
            Err(e) => return Err(e),
        }
    }
}

fn known(engines: &[String]) -> String {
    match engines {
        [] => "is none".to_owned(),
        [one] => format!("is {one}"),
        many => format!("are {}", many.join(", ")),
    }
}

/// The port that makes a process the trainer of a group.
fn action_publisher(
    services: &Services<'_>,
    group: usize,
    specification: &Specification,
) -> Result<ActionPublisher, ServiceError> {
    let service = services.actions(group)?;
    let start = Instant::now();
    loop {
        match ports::publisher(&service, specification.action.blocks(), ACTION_CHUNKS) {
            Ok((publisher, _)) => return Ok(publisher),
            Err(PortError::Other(e)) => return Err(e),
            Err(PortError::Taken) => {}
        }
        // A dead trainer's port is there until someone has removed it; a living one's stays.
        let owner = ports::publishing_node(&service);
        let alive = owner.is_some_and(|owner| services.node.is_alive(owner));
        if alive || start.elapsed() >= CLEANUP_TIMEOUT {
            let pid = owner.and_then(|owner| services.node.process_of(owner));
            return Err(ServiceError::TrainerExists { service: specification.service.clone(), pid });
        }
        services.node.clean();
        std::thread::sleep(RETRY);
    }
}
