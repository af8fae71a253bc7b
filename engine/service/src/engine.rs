//! The engine: receives requests, steps the pools, and sends the batches that they write into shared memory.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use endless_gym_core::batch::{LAYOUT_VERSION, action_layout};
use endless_gym_core::pool::{Pool, PoolError, ResetOptions};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;

use crate::blackboard::{self, PublishedSpecification};
use crate::descriptors;
use crate::engine_config::EngineConfig;
use crate::error::{PACKAGE_VERSION, ServiceError};
use crate::group::{Group, Outcome, RequestSample, chunk_blocks};
use crate::lock::NamespaceLock;
use crate::memory::PrefaultedChunks;
use crate::message::{ResponseHeader, copied};
use crate::namespace::Ipc;
use crate::node::NamespaceNode;
use crate::ports::{self, EngineServices, OpenMode, ServiceNames};
use crate::specification::ServiceSpecification;
use crate::wait::wait;

/// How long an idle engine parks at most, which is also how long it takes to notice its stop flag.
const IDLE_TIMEOUT: Duration = Duration::from_millis(100);

/// How often an idle engine looks for dead processes.
const CLEANUP_INTERVAL: Duration = Duration::from_millis(500);

/// How often an engine checks that it can still be found.
const CHECK_INTERVAL: Duration = Duration::from_millis(500);

/// How often an engine refreshes the times of the namespace's files.
const REFRESH_INTERVAL: Duration = Duration::from_secs(3600);

/// How long an engine that starts waits for the namespace's lock.
const START_PATIENCE: Duration = Duration::from_secs(30);

/// How often an engine tries to start whose files are removed meanwhile.
const START_ATTEMPTS: usize = 3;

/// What an engine has done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EngineSummary {
    /// Batches sent, including those of resets.
    pub batches: u64,
    /// Steps, summed over the environments.
    pub env_steps: u64,
    /// Requests that were rejected.
    pub rejected: u64,
    /// Requests for an earlier incarnation, which were ignored.
    pub dropped: u64,
    /// Batches that no process received.
    pub undelivered: u64,
}

/// Serves groups of environments to a trainer and to observers in other processes.
///
/// ```
/// use std::sync::atomic::{AtomicBool, Ordering};
/// use std::time::Duration;
///
/// use endless_gym_core::pool::{PoolConfig, ResetRequest, Threads};
/// use endless_gym_service::{ConnectConfig, Engine, EngineConfig, Namespace, Trainer};
///
/// # let root = format!("/tmp/endless-doc-{}", std::process::id());
/// # let namespace = Namespace::at(&root);
/// # /*
/// let namespace = Namespace::default();
/// # */
/// let pool = PoolConfig::new("MortarMayhem-Grid-v0", 4);
/// let config = EngineConfig { namespace: namespace.clone(), ..EngineConfig::new("example", pool, Threads::new(1)?) };
/// let mut engine = Engine::new(&config)?;
/// let stop = AtomicBool::new(false);
///
/// std::thread::scope(|scope| {
///     let running = scope.spawn(|| engine.run(&stop));
///     // Usually in another process:
///     let timeout = Duration::from_secs(10);
///     let mut trainer = Trainer::connect(&ConnectConfig { namespace, timeout, ..ConnectConfig::new("example") })?;
///     trainer.reset(0, ResetRequest::Seed(1))?;
///     let first = trainer.receive(0, timeout)?;
///     assert_eq!(first.batch().observation().len(), 4 * 84 * 84 * 3);
///     trainer.send_with(0, |actions| actions.fill(0))?;
///     let second = trainer.receive(0, timeout)?;
///     assert_eq!(second.batch().episode_length(), [1; 4]);
///     stop.store(true, Ordering::Relaxed);
///     let summary = running.join().expect("the engine does not panic")?;
///     assert_eq!((summary.batches, summary.env_steps), (2, 4));
///     Ok::<(), endless_gym_service::ServiceError>(())
/// })?;
/// # drop(engine);
/// # std::fs::remove_dir_all(root).ok();
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Engine {
    // Dropped first: a process that finds the specification expects all other services.
    _published: PublishedSpecification,
    // Ports must be dropped before the node.
    groups: Vec<Group>,
    to_trainer: Notifier<Ipc>,
    to_engine: Listener<Ipc>,
    specification: ServiceSpecification,
    summary: EngineSummary,
    node: NamespaceNode,
}

impl Engine {
    /// Creates the environments and takes the engine's name. Trainers can connect, and are answered while [`run`](Engine::run)
    /// runs.
    ///
    /// # Errors
    ///
    /// [`ServiceError::InvalidName`], [`ServiceError::OutOfRange`] or [`ServiceError::Pool`] for an invalid configuration,
    /// [`ServiceError::Root`] for a namespace that cannot be used, [`ServiceError::EngineExists`] if an engine of that name is
    /// running, [`ServiceError::SharedMemoryTooSmall`] or [`ServiceError::DescriptorLimit`] if there is not enough shared memory or
    /// there are too few file descriptors, [`ServiceError::Version`] if an engine of another version has the name,
    /// [`ServiceError::ForeignSegment`] if another user has taken the namespace's segments, [`ServiceError::EngineUnreachable`] if
    /// the engine's files are removed while it starts, [`ServiceError::NamespaceLocked`] if another process holds the namespace's
    /// lock for too long, and [`ServiceError::Middleware`] for other errors of iceoryx2.
    pub fn new(config: &EngineConfig) -> Result<Self, ServiceError> {
        config.check()?;
        let mut node = NamespaceNode::join(&config.namespace, START_PATIENCE)?;
        blackboard::refuse_second_engine(&node, &config.service, &node.lock()?)?;
        let pools = config.pools()?;
        let pools = || pools.iter().map(|pool| Pool::new(pool, &config.threads)).collect::<Result<Vec<_>, _>>();
        let mut attempt = 1;
        loop {
            match Self::start(config, node, pools()?) {
                // Something has removed the engine's files.
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
    fn start(config: &EngineConfig, node: NamespaceNode, pools: Vec<Pool>) -> Result<Self, ServiceError> {
        let specification = specify(config, &pools[0])?;
        let limits = specification.lease_limits();
        let blocks = chunk_blocks(&specification.batch);
        PrefaultedChunks::check_available(blocks, limits.trainer_chunks() * config.groups)?;
        descriptors::reserve(descriptors::of_engine(config.groups, config.observers))?;
        let names = ServiceNames::new(&config.service, specification.incarnation);
        let services = EngineServices { node: &node, names, mode: OpenMode::Create };
        let creating = node.creating()?;
        let to_engine = ports::listener(&services.events("to_engine", config.groups)?)?;
        let to_trainer = ports::notifier(&services.events("to_trainer", config.groups)?)?;
        let groups = pools
            .into_iter()
            .enumerate()
            .map(|(group, pool)| Group::new(&services, group, pool, limits))
            .collect::<Result<_, _>>()?;
        drop(creating);
        // Last: a process that finds the specification expects all other services.
        let (lock, published) = blackboard::publish(&node, &specification)?;
        let found = Self::check_published(&node, &specification, &lock);
        drop(lock);
        found?;
        let summary = EngineSummary::default();
        Ok(Engine { groups, to_trainer, to_engine, specification, summary, _published: published, node })
    }

    /// Fails unless a trainer could find the engine and all of its services.
    fn check_published(
        node: &NamespaceNode,
        specification: &ServiceSpecification,
        lock: &NamespaceLock,
    ) -> Result<(), ServiceError> {
        let ServiceSpecification { service, incarnation, groups, .. } = specification;
        let found = blackboard::read_locked(node, service, lock)?;
        if found.is_none_or(|found| found.incarnation != *incarnation) {
            return Err(ServiceError::EngineUnreachable { service: service.clone() });
        }
        let services = EngineServices { node, names: ServiceNames::new(service, *incarnation), mode: OpenMode::Open };
        services.events("to_engine", *groups)?;
        services.events("to_trainer", *groups)?;
        for group in 0..*groups {
            services.requests(group)?;
            services.responses(group, specification.lease_limits())?;
        }
        Ok(())
    }

    /// The specification that trainers and observers read.
    pub fn specification(&self) -> &ServiceSpecification {
        &self.specification
    }

    /// Serves requests until `stop` is set. Returns within a tenth of a second after that.
    ///
    /// # Errors
    ///
    /// [`ServiceError::RootRemoved`] within a second after the namespace's directory was removed, so that no trainer finds the engine
    /// any more. [`ServiceError::Middleware`] or [`ServiceError::SharedMemoryTooSmall`] if the engine cannot continue. Faults of a trainer
    /// are no errors: its requests are rejected.
    pub fn run(&mut self, stop: &AtomicBool) -> Result<EngineSummary, ServiceError> {
        let (mut last_request, mut last_cleanup) = (Instant::now(), Instant::now());
        let (mut last_check, mut last_refresh) = (Instant::now(), Instant::now());
        let mut next = 0;
        while !stop.load(Ordering::Relaxed) {
            if last_check.elapsed() >= CHECK_INTERVAL {
                self.node.check_root()?;
                last_check = Instant::now();
                if last_refresh.elapsed() >= REFRESH_INTERVAL {
                    self.node.refresh_files();
                    last_refresh = last_check;
                }
            }
            let Engine { groups, to_engine, .. } = self;
            // Round robin: the group after the last one is polled first, so that no group starves.
            let request = wait(to_engine, IDLE_TIMEOUT, last_request, || {
                let (first, last) = groups.split_at(next);
                let in_turn = last.iter().zip(next..).chain(first.iter().zip(0..));
                for (group, number) in in_turn {
                    if let Some(sample) = group.poll()? {
                        return Ok(Some((number, sample)));
                    }
                }
                Ok(None)
            })?;
            match request {
                Some((group, sample)) => {
                    next = (group + 1) % self.groups.len();
                    self.answer(group, sample)?;
                    last_request = Instant::now();
                }
                None if last_cleanup.elapsed() >= CLEANUP_INTERVAL => {
                    self.node.remove_dead_nodes();
                    last_cleanup = Instant::now();
                }
                None => {}
            }
        }
        Ok(self.summary)
    }

    /// Executes a request and sends the response.
    fn answer(&mut self, number: usize, sample: RequestSample) -> Result<(), ServiceError> {
        let request = copied(sample.user_header());
        if request.layout_version == LAYOUT_VERSION && request.incarnation != self.specification.incarnation {
            tracing::debug!(group = number, "dropped a request for an earlier incarnation");
            self.summary.dropped += 1;
            return Ok(());
        }
        let group = &mut self.groups[number];
        let read = group.read(&self.specification.action, &request, bytemuck::cast_slice(sample.payload()));
        // The chunk returns to the trainer before the step.
        drop(sample);
        let mut batch = group
            .responses
            .loan_slice_uninit(chunk_blocks(&self.specification.batch))
            .map_err(|e| ServiceError::middleware("cannot loan a chunk")(e.to_string()))?;
        group.memory.prefault(batch.payload_mut())?;
        // SAFETY: every byte pattern is a valid block, and the memory is initialised: the operating system zeroes new shared
        // memory, and a recycled chunk holds an earlier response.
        let mut batch = unsafe { batch.assume_init() };
        let outcome =
            read.and_then(|kind| group.execute(kind, &request, bytemuck::cast_slice_mut(batch.payload_mut())));
        let step = group.step + u64::from(matches!(outcome, Ok(Outcome::Batch { .. })));
        let header = batch.user_header_mut();
        *header = ResponseHeader::answering(&request, number, self.specification.incarnation, step);
        match &outcome {
            Ok(Outcome::Batch { .. }) => {}
            Ok(Outcome::Snapshot { bytes }) => header.set_snapshot(*bytes),
            Err((reason, message)) => header.set_rejection(*reason, message),
        }
        // A trainer that dies at this moment must not end the engine.
        let receivers = batch.send().unwrap_or_else(|e| {
            tracing::warn!(error = %e, group = number, "cannot deliver a response");
            0
        });
        ports::notify(&self.to_trainer, number);
        group.step = step;
        match outcome {
            Ok(Outcome::Batch { env_steps }) => {
                self.summary.undelivered += u64::from(receivers == 0);
                self.summary.batches += 1;
                self.summary.env_steps += env_steps as u64;
            }
            Ok(Outcome::Snapshot { .. }) => {}
            Err(_) => self.summary.rejected += 1,
        }
        Ok(())
    }
}

fn specify(config: &EngineConfig, pool: &Pool) -> Result<ServiceSpecification, PoolError> {
    let spec = pool.spec();
    let features: &[_] = if config.pool.features { spec.features } else { &[] };
    Ok(ServiceSpecification {
        service: config.service.clone(),
        layout_version: LAYOUT_VERSION,
        engine_version: PACKAGE_VERSION.to_owned(),
        engine_pid: std::process::id(),
        incarnation: rand::random(),
        id: spec.id.to_owned(),
        groups: config.groups,
        num_envs: config.pool.num_envs,
        batch: pool.layout().clone(),
        action: action_layout(spec, config.pool.num_envs)?,
        frames: config.pool.frames,
        action_space: spec.action_space.clone(),
        info: spec.info.iter().map(|column| column.name.to_owned()).collect(),
        features: features.iter().map(|column| column.name.to_owned()).collect(),
        options: match &config.pool.options {
            ResetOptions::Shared(options) => vec![options.clone()],
            ResetOptions::Each(each) => each.clone(),
        },
        autoreset: config.pool.autoreset,
        render_fps: spec.render_fps,
        batches_held: config.batches_held,
        observers: config.observers,
    })
}

#[cfg(test)]
mod tests {
    use endless_gym_core::pool::{PoolConfig, Threads};

    use super::*;
    use crate::namespace::Namespace;

    #[test]
    fn an_engine_that_cannot_be_found_is_noticed() {
        let namespace = Namespace::at(format!("/tmp/endless-found-{}", std::process::id()));
        let pool = PoolConfig::new("MortarMayhem-Grid-v0", 1);
        let config = EngineConfig::new("gym", pool, Threads::new(1).unwrap());
        let engine = Engine::new(&EngineConfig { namespace: namespace.clone(), ..config }).unwrap();
        let check = || {
            let lock = engine.node.lock().unwrap();
            Engine::check_published(&engine.node, engine.specification(), &lock)
        };
        check().unwrap();
        let services = namespace.root().join("services");
        std::fs::rename(&services, namespace.root().join("elsewhere")).unwrap();
        assert!(matches!(check(), Err(ServiceError::EngineUnreachable { .. })));
        std::fs::rename(namespace.root().join("elsewhere"), &services).unwrap();
        check().unwrap();
        drop(engine);
        std::fs::remove_dir_all(namespace.root()).unwrap();
    }
}
