//! The engine: receives requests, steps the pools, and sends the batches that they write into shared memory.

use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use endless_gym_core::batch::{BatchSection, LAYOUT_VERSION, action_layout};
use endless_gym_core::pool::{Pool, PoolError, Registry, ResetOptions, Threads};
use iceoryx2::port::notifier::Notifier;
use serde_json::json;

use crate::engine::checkpoint::{CheckpointHead, Checkpointer};
use crate::engine::config::EngineConfig;
use crate::engine::group::{Group, Groups, Outcome, Rejected, Taken};
use crate::engine::pictures::{self, PictureDrawer};
use crate::engine::status_writer::{EngineSummary, StatusWriter};
use crate::error::{CheckpointError, PACKAGE_VERSION, Rejection, ServiceError};
use crate::namespace::descriptors;
use crate::namespace::directory::Ipc;
use crate::namespace::memory::PrefaultedChunks;
use crate::namespace::node::NamespaceNode;
use crate::protocol::discovery;
use crate::protocol::message::{RequestKind, ResponseHeader, copied};
use crate::protocol::ports::{self, EngineServices, OpenMode, chunk_blocks};
use crate::protocol::specification::ServiceSpecification;
use crate::protocol::wait::{Doorbell, lock};

/// Longest time an idle engine parks, and so the longest it takes to notice its stop flag.
const IDLE_TIMEOUT: Duration = Duration::from_millis(100);

/// How often an idle engine looks for dead processes.
const CLEANUP_INTERVAL: Duration = Duration::from_millis(500);

/// How long a stopping engine waits for its trainer to end as well.
const LAST_CLEANUP: Duration = Duration::from_millis(100);

/// How often an engine checks that it can still be found, and looks for viewers.
const CHECK_INTERVAL: Duration = Duration::from_millis(500);

/// How often an engine refreshes the times of the namespace's files.
const REFRESH_INTERVAL: Duration = Duration::from_secs(3600);

/// How long a starting engine waits for the namespace's lock.
const START_PATIENCE: Duration = Duration::from_secs(30);

/// How many times an engine tries to start if its files are removed meanwhile.
const START_ATTEMPTS: usize = 3;

/// Serves groups of environments to a trainer and to observers in other processes.
///
/// ```
/// use std::time::Duration;
///
/// use endless_gym_memory_gym::memory_gym;
/// use endless_gym_core::pool::{PoolConfig, ResetRequest};
/// use endless_gym_service::{ConnectConfig, Engine, EngineConfig, Namespace, Trainer};
///
/// # let root = format!("/tmp/endless-doc-{}", std::process::id());
/// # let namespace = Namespace::at(&root);
/// # /*
/// let namespace = Namespace::default();
/// # */
/// let pool = PoolConfig::new("MortarMayhem-Grid-v0", 4);
/// let config = EngineConfig::new("example", pool, 1).namespace(namespace.clone());
/// let engine = Engine::new(memory_gym(), &config)?.spawn()?;
///
/// // Usually in another process:
/// let timeout = Duration::from_secs(10);
/// let mut trainer = Trainer::connect(&ConnectConfig::new("example").namespace(namespace).timeout(timeout))?;
/// trainer.reset(0, ResetRequest::Seed(1))?;
/// let first = trainer.receive(0, timeout)?;
/// assert_eq!(first.batch().observation().len(), 4 * 84 * 84 * 3);
/// trainer.send_with(0, |actions| actions.fill(0))?;
/// let second = trainer.receive(0, timeout)?;
/// assert_eq!(second.batch().episode_length(), [1; 4]);
///
/// engine.stop();
/// let summary = engine.join()?;
/// assert_eq!((summary.batches, summary.env_steps), (2, 4));
/// # drop((first, second, trainer));
/// # std::fs::remove_dir_all(root).ok();
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Engine {
    // Dropped first: a process that finds the specification expects all services.
    status: StatusWriter,
    // Ports are dropped before the node.
    groups: Groups,
    to_trainer: Notifier<Ipc>,
    to_engine: Doorbell,
    servers: Vec<Server>,
    specification: ServiceSpecification,
    checkpointer: Option<Checkpointer>,
    /// `None` if batches have frames, or the environments have none.
    pictures: Option<Mutex<PictureDrawer>>,
    node: NamespaceNode,
}

/// A thread that executes requests at the same time as the others: those of its own groups, whose memory stays in its cache, and
/// while it has none, those of the groups of busy threads.
struct Server {
    groups: Range<usize>,
    /// This thread and the workers that help it to step a large group.
    threads: Threads,
    /// The CPU to which it is bound, as in [`Threads::pin_caller`].
    cpu: Option<usize>,
    /// Whether it is executing a request.
    is_busy: AtomicBool,
}

/// What the first server does besides: when it last did so.
struct Chores {
    cleaned: Instant,
    checked: Instant,
    refreshed: Instant,
}

impl Chores {
    fn new() -> Self {
        let now = Instant::now();
        Chores { cleaned: now, checked: now, refreshed: now }
    }

    /// Checks that the engine can still be found, looks for viewers, and refreshes the namespace's files, if that is due.
    fn check(&mut self, engine: &Engine) -> Result<(), ServiceError> {
        if self.checked.elapsed() < CHECK_INTERVAL {
            return Ok(());
        }
        engine.node.check_root()?;
        self.checked = Instant::now();
        if let Some(pictures) = &engine.pictures {
            lock(pictures).find_viewers();
        }
        if self.refreshed.elapsed() >= REFRESH_INTERVAL {
            engine.node.refresh_files();
            self.refreshed = self.checked;
        }
        Ok(())
    }

    /// Removes what dead processes left, if that is due.
    fn clean(&mut self, engine: &Engine) {
        if self.cleaned.elapsed() >= CLEANUP_INTERVAL {
            let removed = engine.node.remove_dead_nodes() as u64;
            if removed > 0 {
                engine.status.update_engine(|engine| engine.recoveries += removed);
            }
            self.cleaned = Instant::now();
        }
    }
}

/// Sets a flag when it is dropped, also by a panic.
struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

impl Engine {
    /// Creates the environments and takes the engine's name. Trainers can connect from now on, and are served after
    /// [`spawn`](Engine::spawn).
    ///
    /// # Errors
    ///
    /// [`ServiceError::InvalidName`], [`ServiceError::OutOfRange`] or [`ServiceError::Pool`] for an invalid configuration,
    /// [`ServiceError::Root`] for a namespace that cannot be used, [`ServiceError::EngineExists`] if an engine of that name is
    /// running, [`ServiceError::SharedMemoryTooSmall`] or [`ServiceError::DescriptorLimit`] if there is not enough shared memory or
    /// there are too few file descriptors, [`ServiceError::Version`] if an engine of another version has the name,
    /// [`ServiceError::ForeignSegment`] if another user has taken the namespace's segments, [`ServiceError::EngineUnreachable`] if
    /// the engine's files are removed while it starts, [`ServiceError::NamespaceLocked`] if another process holds the namespace's
    /// lock for too long, [`ServiceError::Checkpoint`] for a checkpoint that exists, cannot be written, or cannot be resumed from,
    /// and [`ServiceError::Middleware`] for other errors of iceoryx2.
    pub fn new(registry: &Registry, config: &EngineConfig) -> Result<Self, ServiceError> {
        config.check()?;
        descriptors::reserve(descriptors::of_engine(config.groups, config.observers) + pictures::MAX_VIEWERS)?;
        let mut node = NamespaceNode::join(&config.namespace, START_PATIENCE)?;
        discovery::refuse_second_engine(&node, &config.service, &node.lock()?)?;
        let pools = config.pools()?;
        let threads = Threads::divided(config.threads, config.pool.num_envs, config.groups)?;
        if config.pin_threads {
            (0..threads.len()).try_for_each(|server| threads[server].pin(first_cpu(&threads, server)))?;
        }
        // Each group's pool has its server's threads, which prefault its memory.
        let server =
            |group| (0..threads.len()).rfind(|server| first_group(config, &threads, *server) <= group).unwrap_or(0);
        let pool = |(group, pool)| Pool::new(registry, pool, &threads[server(group)]);
        let pools = || pools.iter().enumerate().map(pool).collect::<Result<Vec<_>, _>>();
        let mut attempt = 1;
        loop {
            match Self::start(config, node, pools()?, &threads) {
                // Another program removed the engine's files.
                Err(ServiceError::EngineUnreachable { .. } | ServiceError::EngineRestarted { .. })
                    if attempt < START_ATTEMPTS => {}
                Err(ServiceError::EngineRestarted { service }) => {
                    return Err(ServiceError::EngineUnreachable { service });
                }
                started => return started,
            }
            attempt += 1;
            tracing::warn!(engine = config.service, "the engine cannot be found; starting it again");
            node = NamespaceNode::join(&config.namespace, START_PATIENCE)?;
        }
    }

    /// Creates the engine's services and publishes them.
    fn start(
        config: &EngineConfig,
        node: NamespaceNode,
        pools: Vec<Pool>,
        threads: &[Threads],
    ) -> Result<Self, ServiceError> {
        let specification = specify(config, &pools[0])?;
        let head = CheckpointHead::new(config, &specification);
        let checkpointer = config.checkpoint.as_ref().map(|config| Checkpointer::new(config, head)).transpose()?;
        let blocks = chunk_blocks(&specification.batch);
        PrefaultedChunks::check_available(blocks, specification.trainer_chunks() * config.groups)?;
        let services = EngineServices { node: &node, specification: &specification, mode: OpenMode::Create };
        let creating = node.creating()?;
        let events = services.events("to_engine")?;
        let to_engine = Doorbell::new(ports::listener(&events)?);
        let waker = (threads.len() > 1).then(|| ports::notifier(&events)).transpose()?;
        let to_trainer = ports::notifier(&services.events("to_trainer")?)?;
        let mut groups: Vec<_> = pools
            .into_iter()
            .enumerate()
            .map(|(group, pool)| Group::new(&services, group, pool))
            .collect::<Result<_, _>>()?;
        let servers = threads.iter().enumerate().map(|(server, own)| Server {
            groups: first_group(config, threads, server)..first_group(config, threads, server + 1),
            threads: own.clone(),
            cpu: config.pin_threads.then(|| first_cpu(threads, server)),
            is_busy: AtomicBool::new(false),
        });
        let servers = servers.collect();
        let mut status = StatusWriter::create(node.prefix(), &specification)?;
        drop(creating);
        if let Some(checkpointer) = &checkpointer {
            checkpointer.resume(&mut groups, &status)?;
        }
        // Last: a process that finds the specification expects all services.
        let lock = node.lock()?;
        discovery::refuse_second_engine(&node, &config.service, &lock)?;
        status.publish()?;
        drop(lock);
        Self::check_published(&node, &specification)?;
        let (service, process) = (&*specification.service, specification.engine_pid);
        tracing::info!(service, process, id = &*specification.id, groups = specification.groups, "engine started");
        let draws = specification.frames.is_none() && specification.shown().is_some();
        let pictures = draws.then(|| Mutex::new(PictureDrawer::new(node.prefix(), specification.incarnation)));
        let groups = Groups::new(groups, waker);
        Ok(Engine { groups, to_trainer, to_engine, servers, specification, status, checkpointer, pictures, node })
    }

    /// Fails unless a trainer could find the engine and all of its services.
    fn check_published(node: &NamespaceNode, specification: &ServiceSpecification) -> Result<(), ServiceError> {
        let ServiceSpecification { service, incarnation, groups, .. } = specification;
        let found = discovery::read(node, service)?;
        if found.is_none_or(|found| found.incarnation != *incarnation) {
            return Err(ServiceError::EngineUnreachable { service: service.clone() });
        }
        let services = EngineServices { node, specification, mode: OpenMode::Open };
        services.events("to_engine")?;
        services.events("to_trainer")?;
        for group in 0..*groups {
            services.requests(group)?;
            services.responses(group)?;
        }
        Ok(())
    }

    /// The specification that trainers and observers read.
    pub fn specification(&self) -> &ServiceSpecification {
        &self.specification
    }

    /// Batches that each group has returned, including those before the checkpoint that the engine resumed from.
    pub fn steps(&self) -> Vec<u64> {
        (0..self.groups.len()).map(|group| self.status.step(group)).collect()
    }

    /// Serves requests in this thread and others until `stop` is set.
    pub(super) fn run(&mut self, stop: &AtomicBool) -> Result<EngineSummary, ServiceError> {
        let (this, ended) = (&*self, AtomicBool::new(false));
        let serve = |server| {
            // A thread that ends, even by a panic, ends the others.
            let _ended = SetOnDrop(&ended);
            this.serve(server, &|| stop.load(Ordering::Relaxed) || ended.load(Ordering::Relaxed))
        };
        std::thread::scope(|scope| {
            let others = (1..this.servers.len()).map(|server| {
                let thread = std::thread::Builder::new().name(format!("endless-server-{server}"));
                let started = thread.spawn_scoped(scope, move || serve(server));
                started.inspect_err(|_| ended.store(true, Ordering::Relaxed))
            });
            let others = others.collect::<Result<Vec<_>, _>>();
            let others = others.map_err(|source| PoolError::Threads { count: this.servers.len(), source })?;
            others.into_iter().fold(serve(0), |served, other| match other.join() {
                Ok(other) => served.and(other),
                Err(panic) => std::panic::resume_unwind(panic),
            })
        })?;
        if let Some(checkpointer) = &self.checkpointer {
            checkpointer.stop(&self.groups, &self.status)?;
        }
        self.remove_ending_trainer();
        let summary = self.status.summary();
        tracing::info!(service = &*self.specification.service, batches = summary.batches, "engine stopped");
        Ok(summary)
    }

    /// The loop of a server, until `stop` returns true.
    fn serve(&self, number: usize, stop: &dyn Fn() -> bool) -> Result<(), ServiceError> {
        let server = &self.servers[number];
        let Server { groups: own, threads, cpu, is_busy } = server;
        if let Some(cpu) = cpu {
            Threads::pin_caller(*cpu)?;
        }
        let (mut last_request, mut next) = (Instant::now(), own.start);
        let mut chores = (number == 0).then(Chores::new);
        while !stop() {
            if let Some(chores) = &mut chores {
                chores.check(self)?;
            }
            let taken = self.to_engine.wait(own, IDLE_TIMEOUT, last_request, || {
                // Round robin, so that no group starves.
                let taken = self.groups.take((next..own.end).chain(own.start..next))?;
                if taken.is_some() {
                    return Ok(taken);
                }
                let busy = self.servers.iter().filter(|server| server.is_busy.load(Ordering::SeqCst));
                self.groups.take(busy.flat_map(|server| server.groups.clone()))
            })?;
            match taken {
                Some(Taken { number, mut group, request }) => {
                    let is_own = own.contains(&number);
                    if is_own {
                        next = number + 1;
                    }
                    self.set_busy(server, usize::from(is_own));
                    group.set_threads(threads);
                    self.answer(Taken { number, group, request })?;
                    if !is_own {
                        self.groups.wake(number);
                    }
                    is_busy.store(false, Ordering::SeqCst);
                    last_request = Instant::now();
                }
                None => {
                    if let Some(chores) = &mut chores {
                        chores.clean(self);
                    }
                    for group in own.clone() {
                        if self.groups.try_lock(group).is_some_and(|mut group| group.repeat_batch()) {
                            self.status.ring(group);
                        }
                    }
                }
            }
            if chores.is_some() && (self.pictures.is_some() || self.checkpointer.is_some()) {
                // Drawing and saving wait for other groups, and for the disk.
                self.set_busy(server, 0);
                self.look_after_files();
                is_busy.store(false, Ordering::SeqCst);
            }
        }
        Ok(())
    }

    /// Lets other servers take the requests to this one's groups, of which it has taken that many; also requests that came before.
    fn set_busy(&self, server: &Server, taken: usize) {
        server.is_busy.store(true, Ordering::SeqCst);
        let has_others = self.servers.len() > 1 && server.groups.len() > taken;
        if has_others && server.groups.clone().any(|group| self.groups.has_request(group)) {
            self.groups.wake_any();
        }
    }

    /// Draws for viewers and saves checkpoints when they are due.
    fn look_after_files(&self) {
        if let Some(pictures) = &self.pictures {
            lock(pictures).draw(&self.groups, &self.status);
        }
        if let Some(checkpointer) = &self.checkpointer {
            checkpointer.poll(&self.groups, &self.status);
        }
    }

    /// Executes a request and sends the response.
    fn answer(&self, Taken { number, mut group, request: sample }: Taken<'_>) -> Result<(), ServiceError> {
        let request = copied(sample.user_header());
        if request.layout_version == LAYOUT_VERSION && request.incarnation != self.specification.incarnation {
            tracing::debug!(group = number, "dropped a request for an earlier incarnation");
            self.status.update_engine(|engine| engine.dropped += 1);
            return Ok(());
        }
        if self.status.begin(number, &request) {
            tracing::info!(group = number, process = request.process, "a trainer sends its first request");
        }
        let read = group.read(&self.specification.action, &request, bytemuck::cast_slice(sample.payload()));
        // Returns the chunk to the trainer before the step.
        drop(sample);
        let kind = read.as_ref().ok().copied();
        let mut saved = None;
        if kind == Some(RequestKind::Checkpoint) {
            group.set_saving(true);
            // Saving visits every group, this one, too.
            drop(group);
            saved = Some(self.save());
            group = self.groups.lock(number);
            group.set_saving(false);
            self.groups.wake(number);
        }
        let mut batch = group.loan()?;
        let payload = bytemuck::cast_slice_mut(batch.payload_mut());
        let outcome = match saved {
            Some(saved) => saved.map(|steps| {
                group.forget_frames(payload);
                bytemuck::cast_slice_mut(payload)[..steps.len()].copy_from_slice(&steps);
                Outcome::Snapshot { bytes: size_of_val(&*steps) }
            }),
            None => read.and_then(|kind| group.execute(kind, &request, payload)),
        };
        if let (Ok(_), Some(checkpointer)) = (&outcome, &self.checkpointer)
            && !kind.is_some_and(RequestKind::changes_nothing)
        {
            checkpointer.mark_changed();
        }
        let step = self.status.step(number) + u64::from(matches!(outcome, Ok(Outcome::Batch { .. })));
        let text = match &outcome {
            Err((_, message)) => group.write_rejection(bytemuck::cast_slice_mut(batch.payload_mut()), message),
            Ok(_) => 0,
        };
        let header = batch.user_header_mut();
        *header = ResponseHeader::answering(&request, number, self.specification.incarnation, step);
        match &outcome {
            Ok(Outcome::Batch { .. }) => {}
            Ok(Outcome::Snapshot { bytes }) => header.set_snapshot(*bytes),
            Err((reason, _)) => header.set_rejection(*reason, text),
        }
        let panic = match &outcome {
            Err((Rejection::Panic, panic)) => Some(ServiceError::Panic { group: number, panic: panic.clone() }),
            _ => None,
        };
        // Before the response is sent, so that a trainer that has it sees it in the status. A request that panicked stays
        // unfinished there: it was played in part.
        if panic.is_none() {
            self.status.end(number, step, outcome.as_ref().ok());
        }
        // A trainer that dies at this moment must not end the engine.
        let sent = match outcome {
            Ok(Outcome::Batch { .. }) => group.send_batch(batch),
            _ => batch.send(),
        };
        let receivers = sent.unwrap_or_else(|e| {
            tracing::warn!(error = %e, group = number, "cannot deliver a response");
            0
        });
        ports::notify(&self.to_trainer, number);
        // After the trainer, which is one of the receivers unless it has died.
        if receivers > 1 {
            self.status.ring(number);
        }
        if receivers == 0 && matches!(outcome, Ok(Outcome::Batch { .. })) {
            self.status.update_group(number, |group| group.undelivered += 1);
        }
        panic.map_or(Ok(()), Err)
    }

    /// Saves a checkpoint, and returns the step of each group.
    fn save(&self) -> Result<Vec<u64>, Rejected> {
        let checkpointer = self.checkpointer.as_ref().ok_or(CheckpointError::NoFile);
        checkpointer.and_then(|checkpointer| checkpointer.save(&self.groups, &self.status)).map_err(|e| match e {
            CheckpointError::NotReset => (Rejection::NotReset, e.to_string()),
            e => (Rejection::Checkpoint, e.to_string()),
        })
    }

    /// Removes the resources of a trainer that ends together with the engine: an engine often stops because its trainer
    /// was killed, and then no other process would clean up after it.
    fn remove_ending_trainer(&self) {
        let services = EngineServices { node: &self.node, specification: &self.specification, mode: OpenMode::Open };
        let has_trainer = |group| services.requests(group).is_ok_and(|port| ports::publisher_of(&port).is_some());
        let start = Instant::now();
        while start.elapsed() < LAST_CLEANUP && (0..self.specification.groups).any(has_trainer) {
            self.node.remove_dead_nodes();
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// The first group of a server.
fn first_group(config: &EngineConfig, threads: &[Threads], server: usize) -> usize {
    server * config.groups / threads.len()
}

/// The CPU of a server, which those of its workers follow.
fn first_cpu(threads: &[Threads], server: usize) -> usize {
    threads[..server].iter().map(Threads::count).sum()
}

fn specify(config: &EngineConfig, pool: &Pool) -> Result<ServiceSpecification, PoolError> {
    let spec = pool.spec();
    let has_features = pool.layout().section(BatchSection::Features).is_some();
    let features: &[_] = if has_features { spec.features } else { &[] };
    let frames = config.pool.frames.filter(|_| spec.frame.is_some());
    Ok(ServiceSpecification {
        service: config.service.clone(),
        layout_version: LAYOUT_VERSION,
        engine_version: PACKAGE_VERSION.to_owned(),
        engine_pid: std::process::id(),
        incarnation: rand::random(),
        id: spec.id.to_owned(),
        environment: json!(spec),
        groups: config.groups,
        num_envs: config.pool.num_envs,
        first_env: config.pool.first_env,
        batch: pool.layout().clone(),
        action: action_layout(&spec.action_space, config.pool.num_envs)?,
        frames,
        frame: spec.frame.filter(|_| frames.is_some()),
        action_space: spec.action_space.clone(),
        info: spec.info.iter().map(|column| column.name.to_owned()).collect(),
        features: features.iter().map(|column| column.name.to_owned()).collect(),
        options: match &config.pool.options {
            ResetOptions::Shared(options) => vec![options.clone()],
            ResetOptions::Each(each) => each.clone(),
        },
        independent_episodes: config.pool.independent_episodes,
        autoreset: config.pool.autoreset,
        render_fps: spec.render_fps,
        batches_held: config.batches_held,
        observers: config.observers,
    })
}

#[cfg(test)]
mod tests {
    use endless_gym_core::pool::PoolConfig;
    use endless_gym_memory_gym::memory_gym;

    use super::*;
    use crate::namespace::directory::Namespace;

    #[test]
    fn an_engine_notices_that_its_services_cannot_be_found() {
        let namespace = Namespace::at(format!("/tmp/endless-found-{}", std::process::id()));
        let pool = PoolConfig::new("MortarMayhem-Grid-v0", 1);
        let config = EngineConfig::new("gym", pool, 1);
        let engine = Engine::new(memory_gym(), &config.namespace(namespace.clone())).unwrap();
        let check = || Engine::check_published(&engine.node, engine.specification());
        check().unwrap();
        let services = namespace.root().join("services");
        std::fs::rename(&services, namespace.root().join("elsewhere")).unwrap();
        assert!(matches!(check(), Err(ServiceError::EngineRestarted { .. })));
        std::fs::rename(namespace.root().join("elsewhere"), &services).unwrap();
        check().unwrap();
        drop(engine);
        std::fs::remove_dir_all(namespace.root()).unwrap();
    }
}
