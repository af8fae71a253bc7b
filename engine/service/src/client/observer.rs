//! The observer: reads a group's batches in addition to the trainer.

use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use endless_gym_core::batch::BLOCK_BYTES;
use iceoryx2::prelude::{CallbackProgression, PortFactory};
use rustix::fs::FallocateFlags;
use rustix::io::Errno;

use crate::client::connect::{ConnectConfig, connect_to_engine};
use crate::client::lease::{BatchLease, Response, ResponsePort, ResponseService};
use crate::client::status;
use crate::error::ServiceError;
use crate::namespace::iceoryx_files::data_segment;
use crate::namespace::node::NamespaceNode;
use crate::namespace::{descriptors, memory};
use crate::protocol::ports::{self, EngineServices, OpenMode, chunk_blocks};
use crate::protocol::specification::ServiceSpecification;
use crate::protocol::status_file::{self, Bells, ObserverRecord, StatusFile, StatusReader, now};
use crate::protocol::wait::LIVENESS_INTERVAL;

/// The status files of the engine and the observer.
const STATUS_DESCRIPTORS: usize = 2;

/// How often a waiting observer polls if it cannot map the engine's bells.
const POLL_INTERVAL: Duration = Duration::from_millis(1);

/// Reads the batches of one group while a trainer steps it.
///
/// The engine does not wait for observers. An observer sees the newest batch and misses older ones that it did not
/// receive in time. Shared memory for the batches that it may hold is reserved when it connects, so that the engine
/// never runs out.
///
/// ```no_run
/// use std::time::Duration;
///
/// use endless_gym_service::{ConnectConfig, Observer};
///
/// let mut observer = Observer::connect(&ConnectConfig::new("endless"), 0)?;
/// loop {
///     let lease = observer.next(Duration::from_secs(10))?;
///     println!("step {}: rewards {:?}", lease.step(), lease.batch().reward());
/// }
/// # #[allow(unreachable_code)]
/// # Ok::<(), endless_gym_service::ServiceError>(())
/// ```
pub struct Observer {
    /// `None` while this observer is paused.
    port: Option<Arc<ResponsePort>>,
    /// The last port, which lives until the last lease received through it is dropped.
    last_port: Weak<ResponsePort>,
    service: ResponseService,
    group: usize,
    /// The number of the last batch that was received.
    last_step: Option<u64>,
    /// The engine's status, and what wakes this observer; `None` if they cannot be read.
    bells: Option<Bells>,
    status: Option<ObserverStatusWriter>,
    specification: Arc<ServiceSpecification>,
    node: Arc<NamespaceNode>,
}

impl Observer {
    /// Connects to a group of an engine.
    ///
    /// # Errors
    ///
    /// [`ServiceError::UnknownEngine`] if no engine of that name appears within the timeout, [`ServiceError::NoSuchGroup`] if it
    /// has no such group, [`ServiceError::TooManyObservers`] if the group has as many observers as it accepts,
    /// [`ServiceError::SharedMemoryTooSmall`] if there is no room for the batches that the observer may hold,
    /// [`ServiceError::EngineRestarted`] if the engine ended while this process connected, [`ServiceError::Version`],
    /// [`ServiceError::IncompatibleTypes`] or [`ServiceError::Specification`] for an engine of another version,
    /// [`ServiceError::InvalidName`] or [`ServiceError::Root`] for an invalid configuration, [`ServiceError::NamespaceLocked`] if
    /// another process holds the namespace's lock for too long, and [`ServiceError::Middleware`] for other errors of iceoryx2.
    pub fn connect(config: &ConnectConfig, group: usize) -> Result<Self, ServiceError> {
        let (node, (port, service), specification) = connect_to_engine(config, |node, specification| {
            let groups = specification.groups;
            if group >= groups {
                let service = specification.service.clone();
                return Err(ServiceError::NoSuchGroup { service, given: group, groups });
            }
            let services = EngineServices { node, specification, mode: OpenMode::Open };
            descriptors::reserve(descriptors::of_trainer(1) + STATUS_DESCRIPTORS)?;
            // One observer connects at a time, so that each counts those before it.
            let _lock = node.lock()?;
            reserve_for_observer(&services, group)?;
            let service = ResponseService::open(&services, node, group)?;
            Ok((service.port(specification, false)?, service))
        })?;
        let status = status_file::path(node.prefix(), &specification.service, specification.incarnation);
        let port = Arc::new(port);
        Ok(Observer {
            last_port: Arc::downgrade(&port),
            port: Some(port),
            service,
            group,
            last_step: None,
            bells: Bells::open(&status),
            status: ObserverStatusWriter::create(&node, &specification, group),
            specification: Arc::new(specification),
            node,
        })
    }

    /// The engine's specification.
    pub fn specification(&self) -> &ServiceSpecification {
        &self.specification
    }

    fn engine(&self) -> Option<&StatusReader> {
        self.bells.as_ref().map(|bells| &bells.status)
    }

    pub(crate) fn node(&self) -> &NamespaceNode {
        &self.node
    }

    /// The newest batch, or `None` if there has been none since the last call.
    ///
    /// # Errors
    ///
    /// [`ServiceError::TooManyBatchesHeld`] if [`batches_held`](ServiceSpecification::batches_held) leases are held,
    /// and [`ServiceError::IncompatibleTypes`] for a malformed message. After a [pause](Observer::pause), also
    /// [`ServiceError::SharedMemoryTooSmall`], [`ServiceError::RootRemoved`] or [`ServiceError::Middleware`] if this
    /// observer cannot resume.
    pub fn newest(&mut self) -> Result<Option<BatchLease>, ServiceError> {
        let Some(port) = self.connected()? else { return Ok(None) };
        let batch = port.receive(&self.specification)?.and_then(Response::into_batch);
        // The engine repeats a batch for an observer that has resumed.
        let batch = batch.filter(|batch| self.last_step != Some(batch.step()));
        self.last_step = batch.as_ref().map(BatchLease::step).or(self.last_step);
        if let (Some(status), Some(_)) = (&mut self.status, &batch) {
            // Each lease holds a reference to the port, and so do this observer and this call.
            status.received(Arc::strong_count(&port) - 2);
        }
        Ok(batch)
    }

    /// The port, created again after a pause; `None` if that is not possible yet.
    fn connected(&mut self) -> Result<Option<Arc<ResponsePort>>, ServiceError> {
        let port = match self.port.take().or_else(|| self.last_port.upgrade()) {
            Some(port) => port,
            None => {
                let creating = self.node.creating()?;
                memory::check_free(memory::MARGIN)?;
                match self.service.port(&self.specification, true) {
                    Ok(port) => Arc::new(port),
                    // A dead process's port occupies this observer's slot.
                    Err(ServiceError::TooManyObservers { .. }) => {
                        drop(creating);
                        self.node.remove_dead_nodes();
                        return Ok(None);
                    }
                    Err(e) => return Err(e),
                }
            }
        };
        self.last_port = Arc::downgrade(&port);
        self.port = Some(Arc::clone(&port));
        Ok(Some(port))
    }

    /// Stops receiving until the next call of [`newest`](Observer::newest) or [`next`](Observer::next), which return
    /// the next batch that the engine writes. If the trainer pauses, the engine sends the last one again within 0.2 s.
    /// The observer keeps its slot and its reserved memory.
    ///
    /// The queue of an active observer always holds the newest batch, so that the engine cannot reuse that memory,
    /// which is in its cache, for the next one. A paused observer costs the engine nothing. Leases stay valid, and the
    /// pause begins when the last one is dropped.
    pub fn pause(&mut self) {
        // A paused observer is counted by its status, so it needs one. Without memory for a new port, it keeps its
        // port.
        if self.status.is_some() && memory::check_free(memory::MARGIN).is_ok() {
            self.port = None;
        }
    }

    /// Whether this observer is paused.
    pub fn is_paused(&self) -> bool {
        self.port.is_none() && self.last_port.strong_count() == 0
    }

    /// Number of batches that the group has returned, which is the newest one's [`BatchLease::step`], from the engine's
    /// status; `None` if that cannot be read. Costs the engine nothing and works while this observer is paused.
    pub fn step(&self) -> Option<u64> {
        self.engine().and_then(|engine| engine.group(self.group)).map(|group| group.step)
    }

    /// Whether [`newest`](Observer::newest) would return a batch, that is, whether the engine has written one since the
    /// last call. Receives nothing. False while this observer is [paused](Observer::pause).
    pub fn has_newer(&self) -> bool {
        self.port.as_ref().is_some_and(|port| port.has_response())
    }

    /// Checks that the engine is running.
    ///
    /// # Errors
    ///
    /// [`ServiceError::EngineLost`] if its process has ended, and [`ServiceError::RootRemoved`] if the namespace's directory was
    /// removed.
    pub fn check_alive(&self) -> Result<(), ServiceError> {
        if self.node.is_alive(self.service.engine()) {
            return Ok(());
        }
        self.node.check_root()?;
        let (service, pid) = (self.specification.service.clone(), self.specification.engine_pid);
        Err(ServiceError::EngineLost { service, pid })
    }

    /// The next batch. Waits for it up to `timeout`.
    ///
    /// # Errors
    ///
    /// [`ServiceError::TimedOut`] if there was no batch in time (it says what the engine was doing),
    /// [`ServiceError::EngineLost`] within half a second after the engine's process has ended,
    /// [`ServiceError::RootRemoved`] if the namespace's directory was removed, and the errors of
    /// [`newest`](Observer::newest).
    pub fn next(&mut self, timeout: Duration) -> Result<BatchLease, ServiceError> {
        next(std::slice::from_mut(self), 0, timeout).map(|(_, lease)| lease)
    }
}

/// The next batch of any of these observers of one engine, and its observer's place. `turn` is the place that is polled first.
fn next(observers: &mut [Observer], turn: usize, timeout: Duration) -> Result<(usize, BatchLease), ServiceError> {
    let (start, count) = (Instant::now(), observers.len());
    let mut last_check = start;
    loop {
        let left = timeout.saturating_sub(start.elapsed());
        let is_due = left.is_zero() || last_check.elapsed() >= LIVENESS_INTERVAL;
        // Check before polling, so that the poll still finds the last batch of an engine that has ended.
        let alive = if is_due { observers[0].check_alive() } else { Ok(()) };
        // One observer waits for its group, several for all groups.
        let first = &observers[0];
        let bell = if count == 1 { first.group } else { first.specification.groups };
        // Read before polling, so that no batch after the poll is missed.
        let seen = first.bells.as_ref().map(|bells| bells.count(bell));
        for place in (turn..count).chain(0..turn) {
            if let Some(lease) = observers[place].newest()? {
                return Ok((place, lease));
            }
        }
        alive?;
        let first = &observers[0];
        if left.is_zero() {
            let activity = status::observed_activity(first.engine(), first.group);
            let service = first.specification.service.clone();
            return Err(ServiceError::TimedOut { service, waited: timeout, activity });
        }
        if is_due {
            last_check = Instant::now();
        }
        match (&first.bells, seen) {
            (Some(bells), Some(seen)) => bells.wait(bell, seen, left.min(LIVENESS_INTERVAL)),
            _ => std::thread::sleep(left.min(POLL_INTERVAL)),
        }
    }
}

/// Reads the batches of one or all groups of an engine while a trainer steps them, and counts the missed batches.
///
/// ```no_run
/// use std::time::Duration;
///
/// use endless_gym_service::{ConnectConfig, Observers};
///
/// let mut observers = Observers::connect(&ConnectConfig::new("endless"), None)?;
/// loop {
///     let observed = observers.next(Duration::from_secs(10))?;
///     println!("group {} step {}, {} missed", observed.lease.group(), observed.lease.step(), observed.missed);
/// }
/// # #[allow(unreachable_code)]
/// # Ok::<(), endless_gym_service::ServiceError>(())
/// ```
pub struct Observers {
    observers: Vec<Observer>,
    /// The step of the last batch of each observer.
    steps: Vec<Option<u64>>,
    /// The observer that is polled first, so that a fast group does not starve the others.
    turn: usize,
}

/// A batch that was observed.
#[derive(Debug)]
pub struct Observed {
    /// The batch.
    pub lease: BatchLease,
    /// Batches of its group between the previously observed one and this one; 0 for the first.
    pub missed: u64,
}

impl Observers {
    /// Connects to one group of an engine, or to all for `None`. `config.timeout` applies to each group.
    ///
    /// # Errors
    ///
    /// As [`Observer::connect`].
    pub fn connect(config: &ConnectConfig, group: Option<usize>) -> Result<Self, ServiceError> {
        let mut observers = vec![Observer::connect(config, group.unwrap_or(0))?];
        if group.is_none() {
            for group in 1..observers[0].specification().groups {
                let observer = Observer::connect(config, group)?;
                if observer.specification().incarnation != observers[0].specification().incarnation {
                    return Err(ServiceError::EngineRestarted { service: config.service.clone() });
                }
                observers.push(observer);
            }
        }
        Ok(Observers { steps: vec![None; observers.len()], observers, turn: 0 })
    }

    /// The engine's specification.
    pub fn specification(&self) -> &ServiceSpecification {
        self.first().specification()
    }

    /// The observer of the first of the groups.
    pub fn first(&self) -> &Observer {
        &self.observers[0]
    }

    /// The next batch of any of the groups. Waits for it up to `timeout`.
    ///
    /// # Errors
    ///
    /// As [`Observer::next`].
    pub fn next(&mut self, timeout: Duration) -> Result<Observed, ServiceError> {
        let (place, lease) = next(&mut self.observers, self.turn, timeout)?;
        self.turn = (place + 1) % self.observers.len();
        let before = self.steps[place].replace(lease.step());
        let missed = before.map_or(0, |before| lease.step().saturating_sub(before.saturating_add(1)));
        Ok(Observed { lease, missed })
    }
}

/// Publishes what an observer holds.
#[derive(Debug)]
pub(crate) struct ObserverStatusWriter {
    file: StatusFile,
    record: ObserverRecord,
}

impl ObserverStatusWriter {
    /// `None` if there is no memory or descriptor for it: an observer works without a status.
    pub(crate) fn create(node: &NamespaceNode, specification: &ServiceSpecification, group: usize) -> Option<Self> {
        // Under the creation lock, since another process would remove the file while it is empty.
        let _creating = node.creating().ok()?;
        let record = ObserverRecord { process: std::process::id(), group: group as u32, ..ObserverRecord::default() };
        let path = status_file::observer_path(node.prefix(), specification.incarnation, rand::random());
        let created = StatusFile::create_observer(&path, &record);
        let created = created.inspect_err(|e| tracing::debug!(error = %e, "cannot publish what this observer holds"));
        created.ok().map(|file| ObserverStatusWriter { file, record })
    }

    /// A batch was received; `held` batches are held, including this one.
    pub(crate) fn received(&mut self, held: usize) {
        let ObserverRecord { batches, .. } = self.record;
        self.record = ObserverRecord { batches: batches + 1, last_batch: now(), held: held as u32, ..self.record };
        self.file.write_first(&self.record);
    }
}

/// Allocates memory for the batches that one more observer of a group may hold. The caller holds the namespace's lock,
/// so that no other observer connects meanwhile.
pub(crate) fn reserve_for_observer(services: &EngineServices<'_>, group: usize) -> Result<(), ServiceError> {
    let specification = services.specification;
    let responses = services.responses(group)?;
    let trainer = services.requests(group).ok().and_then(|requests| ports::publisher_of(&requests));
    let trainer = trainer.map(|trainer| trainer.node_id);
    let mut ports = 0;
    responses.dynamic_config().list_subscribers(|subscriber| {
        ports += usize::from(Some(subscriber.node_id) != trainer);
        CallbackProgression::Continue
    });
    // A paused observer has a status but no port. A dead observer may have left a port, and one without a status also
    // has a port.
    let statuses = status_file::running_observers(services.node.prefix(), specification.incarnation);
    let statuses = statuses.iter().filter(|observer| observer.group as usize == group).count();
    let observers = 1 + statuses.max(ports);
    if observers > specification.observers {
        let (service, limit) = (specification.service.clone(), specification.observers);
        return Err(ServiceError::TooManyObservers { service, limit });
    }
    let restarted = || ServiceError::EngineRestarted { service: specification.service.clone() };
    let publisher = ports::publisher_of(&responses).ok_or_else(restarted)?.publisher_id.value();
    let path = data_segment(publisher, services.node.config()).ok_or_else(restarted)?;
    let segment = File::options().read(true).write(true).open(&path).map_err(|_| restarted())?;

    let unused = specification.observer_chunks() * (specification.observers - observers);
    let chunk = (chunk_blocks(&specification.batch) * BLOCK_BYTES) as u64;
    let failed = ServiceError::file("cannot reserve shared memory", &path);
    let bytes = segment.metadata().map_err(&failed)?.len().saturating_sub(chunk * unused as u64).max(1);
    // `blocks` counts what is already allocated, in units of 512 bytes. The observer's port needs memory, too.
    let allocated = segment.metadata().map_err(&failed)?.blocks().saturating_mul(512);
    memory::check_free(bytes.saturating_sub(allocated).saturating_add(memory::MARGIN))?;
    match rustix::fs::fallocate(&segment, FallocateFlags::KEEP_SIZE, 0, bytes) {
        Ok(()) => Ok(()),
        Err(Errno::NOSPC | Errno::NOMEM) => Err(memory::too_small(chunk * specification.observer_chunks() as u64)),
        // The file system cannot allocate in advance.
        Err(Errno::OPNOTSUPP | Errno::NOSYS) => memory::check_free(chunk * specification.observer_chunks() as u64),
        Err(e) => Err(failed(e.into())),
    }
}
