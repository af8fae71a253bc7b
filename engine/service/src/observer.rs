//! The observer: reads a group's batches in addition to the trainer.

use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use crate::connect::{ConnectConfig, connect_to_engine};
use crate::descriptors;
use crate::error::ServiceError;
use crate::lease::{BatchLease, Response, ResponsePort, ResponseService};
use crate::memory;
use crate::node::NamespaceNode;
use crate::observer_status::ObserverStatusWriter;
use crate::ports::{EngineServices, OpenMode, ServiceNames};
use crate::reservation;
use crate::specification::ServiceSpecification;
use crate::status;
use crate::status_file::{self, StatusReader};
use crate::wait::LIVENESS_INTERVAL;

/// The files of the engine's status and of the observer's own.
const STATUS_DESCRIPTORS: usize = 2;

/// How often a waiting observer polls.
const POLL_INTERVAL: Duration = Duration::from_millis(1);

/// Reads the batches of one group while a trainer steps it.
///
/// The engine does not wait for observers. An observer sees the newest batch and misses those before it that it did not receive
/// in time. Before it connects, the shared memory for the batches that it may hold is reserved, so that what it holds is never
/// missing to the engine.
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
    /// The last port, which exists until the last lease that was received through it is dropped.
    last_port: Weak<ResponsePort>,
    service: ResponseService,
    group: usize,
    /// The number of the last batch that was received.
    last_step: Option<u64>,
    /// The engine's status; `None` if it cannot be read.
    engine: Option<StatusReader>,
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
            let (service, groups) = (specification.service.clone(), specification.groups);
            if group >= groups {
                return Err(ServiceError::NoSuchGroup { service, given: group, groups });
            }
            let names = ServiceNames::new(&service, specification.incarnation);
            let services = EngineServices { node, names, mode: OpenMode::Open };
            descriptors::reserve(descriptors::of_trainer(1) + STATUS_DESCRIPTORS)?;
            // One observer at a time, so that each counts those before it.
            let _lock = node.lock()?;
            reservation::reserve_for_observer(&services, group, specification)?;
            let service = ResponseService::open(&services, node, group, specification)?;
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
            engine: StatusReader::open(&status),
            status: ObserverStatusWriter::create(&node, &specification, group),
            specification: Arc::new(specification),
            node,
        })
    }

    /// The engine's specification.
    pub fn specification(&self) -> &ServiceSpecification {
        &self.specification
    }

    /// The newest batch, or `None` if there has been none since the last call.
    ///
    /// # Errors
    ///
    /// [`ServiceError::TooManyBatchesHeld`] if [`batches_held`](ServiceSpecification::batches_held) leases are held, and
    /// [`ServiceError::IncompatibleTypes`] for a malformed message. After a [pause](Observer::pause) also
    /// [`ServiceError::SharedMemoryTooSmall`], [`ServiceError::RootRemoved`] and [`ServiceError::Middleware`], if this observer cannot
    /// receive again.
    pub fn newest(&mut self) -> Result<Option<BatchLease>, ServiceError> {
        let Some(port) = self.connected()? else { return Ok(None) };
        let batch = port.receive(&self.specification)?.and_then(Response::into_batch);
        // The engine repeats a batch for an observer that has resumed.
        let batch = batch.filter(|batch| self.last_step != Some(batch.step()));
        self.last_step = batch.as_ref().map(BatchLease::step).or(self.last_step);
        if let (Some(status), Some(_)) = (&mut self.status, &batch) {
            // Each lease holds the port, and so do this observer and this call.
            status.received(Arc::strong_count(&port) - 2);
        }
        Ok(batch)
    }

    /// The port, made anew after a pause; `None` if it cannot be made yet.
    fn connected(&mut self) -> Result<Option<Arc<ResponsePort>>, ServiceError> {
        let port = match self.port.take().or_else(|| self.last_port.upgrade()) {
            Some(port) => port,
            None => {
                let creating = self.node.creating()?;
                memory::check_free(memory::MARGIN)?;
                match self.service.port(&self.specification, true) {
                    Ok(port) => Arc::new(port),
                    // The place of this observer is taken by what a dead process has left.
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

    /// Receives nothing until the next call of [`newest`](Observer::newest) or [`next`](Observer::next), which ask for the next batch
    /// that the engine writes. If the trainer pauses, the engine sends the last one again within two tenths of a second. The
    /// place of the observer and the memory that is reserved for it remain.
    ///
    /// The queue of an observer that is not paused always holds the newest batch, so that the engine cannot write the next one to
    /// the same memory, which is in its cache. A paused observer costs the engine nothing. A lease that is held remains valid, and
    /// the pause begins when it is dropped.
    pub fn pause(&mut self) {
        // A paused observer is counted by its status. Without memory for a new port, it keeps the one that it has.
        if self.status.is_some() && memory::check_free(memory::MARGIN).is_ok() {
            self.port = None;
        }
    }

    /// Whether this observer is paused.
    pub fn is_paused(&self) -> bool {
        self.port.is_none() && self.last_port.strong_count() == 0
    }

    /// Number of batches that the group has returned, as [`BatchLease::step`] of the newest one, from the engine's status; `None` if
    /// that cannot be read. Costs the engine nothing, also while this observer is paused.
    pub fn step(&self) -> Option<u64> {
        self.engine.as_ref().and_then(|engine| engine.group(self.group)).map(|group| group.step)
    }

    /// Whether [`newest`](Observer::newest) would return a batch: whether the engine has written one since the last call. Nothing
    /// is received. False while this observer is [paused](Observer::pause).
    pub fn has_newer(&self) -> bool {
        self.port.as_ref().is_some_and(|port| port.has_response())
    }

    /// Checks that the engine runs.
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
    /// [`ServiceError::TimedOut`] if there was no batch in time, which says what the engine was doing, [`ServiceError::EngineLost`]
    /// within half a second after the engine's process has ended, [`ServiceError::RootRemoved`] if the namespace's directory was
    /// removed, and the errors of [`newest`](Observer::newest).
    pub fn next(&mut self, timeout: Duration) -> Result<BatchLease, ServiceError> {
        let start = Instant::now();
        let mut last_check = start;
        loop {
            let is_over = start.elapsed() >= timeout;
            let is_due = is_over || last_check.elapsed() >= LIVENESS_INTERVAL;
            // Before the poll, which then also finds the last batch of an engine that has ended.
            let alive = if is_due { self.check_alive() } else { Ok(()) };
            if let Some(lease) = self.newest()? {
                return Ok(lease);
            }
            alive?;
            if is_over {
                let activity = status::observed_activity(self.engine.as_ref(), self.group);
                let service = self.specification.service.clone();
                return Err(ServiceError::TimedOut { service, waited: timeout, activity });
            }
            if is_due {
                last_check = Instant::now();
            }
            std::thread::sleep(POLL_INTERVAL.min(timeout));
        }
    }
}
