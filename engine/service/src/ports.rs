//! The middleware's nodes, services and ports, as this room uses them.

use std::time::Duration;

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{
    AllocationStrategy, BackpressureStrategy, CallbackProgression, EventId, PortFactory, ServiceName, ZeroCopySend,
};
use iceoryx2::service::builder::event::EventOpenError;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::error::ServiceError;
use super::message::{ActionHeader, ObservationHeader, PayloadBlock};
use super::node::{Ipc, Member};
use super::preflight::Resident;

pub(super) type ActionService = publish_subscribe::PortFactory<Ipc, [PayloadBlock], ActionHeader>;
pub(super) type BlockPublisher<H> = Publisher<Ipc, [PayloadBlock], H>;
pub(super) type ActionPublisher = BlockPublisher<ActionHeader>;
pub(super) type ActionSubscriber = Subscriber<Ipc, [PayloadBlock], ActionHeader>;
pub(super) type ObservationService = publish_subscribe::PortFactory<Ipc, [PayloadBlock], ObservationHeader>;
pub(super) type ObservationPublisher = BlockPublisher<ObservationHeader>;
pub(super) type ObservationSubscriber = Subscriber<Ipc, [PayloadBlock], ObservationHeader>;

/// Nodes that may open a service at a time: the engine, its trainer, observers, and those about to be refused.
const MAX_NODES: usize = 64;

/// Names of one engine's services. All but the specification's carry the epoch, so that an engine that starts anew shares
/// nothing with what a dead one left.
#[derive(Clone, Debug)]
pub(super) struct Names {
    service: String,
    epoch: u64,
}

/// What the name of every specification starts with.
pub(super) const SPECIFICATION_PREFIX: &str = "endless-gym/";

impl Names {
    pub(super) fn new(service: &str, epoch: u64) -> Self {
        Names { service: service.to_owned(), epoch }
    }

    pub(super) fn specification(service: &str) -> Result<ServiceName, ServiceError> {
        Self::name(format!("{SPECIFICATION_PREFIX}{service}"))
    }

    fn of_epoch(&self, what: &str) -> Result<ServiceName, ServiceError> {
        Self::name(format!("{SPECIFICATION_PREFIX}{}/{:016x}/{what}", self.service, self.epoch))
    }

    fn name(text: String) -> Result<ServiceName, ServiceError> {
        ServiceName::new(&text).map_err(|e| ServiceError::middleware("cannot name a service")(e.to_string()))
    }
}

/// How many batches a group's trainer and observers may hold, which fixes how many chunks of memory there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Limits {
    pub batches_held: usize,
    pub observers: usize,
}

impl Limits {
    /// Chunks that the trainer alone can bring into use: those it holds, one on its way and one being written.
    pub(super) fn resident(self) -> usize {
        self.batches_held + 2
    }
}

/// Whether the services are made or must be there already.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Open {
    Create,
    Existing,
}

/// Makes or opens the services of one engine.
pub(super) struct Services<'a> {
    pub node: &'a Member,
    pub names: Names,
    pub open: Open,
}

macro_rules! create_or_open {
    ($self:ident, $builder:expr, $error:ident) => {
        match $self.open {
            Open::Create => {
                $builder.create().map_err(|e| ServiceError::middleware("cannot create a service")(e.to_string()))
            }
            Open::Existing => $builder.open().map_err(|e| match e {
                $error::DoesNotExist
                | $error::IsMarkedForDestruction
                | $error::HangsInCreation
                | $error::ServiceInCorruptedState => {
                    ServiceError::EngineRestarted { service: $self.names.service.clone() }
                }
                e => $self.open_error(&format!("{e:?}")),
            }),
        }
    };
}

impl Services<'_> {
    /// The service of one group's actions: one trainer, one engine.
    pub(super) fn actions(&self, group: usize) -> Result<ActionService, ServiceError> {
        let builder = self
            .node
            .service_builder(&self.names.of_epoch(&format!("act/{group}"))?)
            .publish_subscribe::<[PayloadBlock]>()
            .user_header::<ActionHeader>()
            .enable_safe_overflow(true)
            .history_size(0)
            .subscriber_max_buffer_size(1)
            .subscriber_max_borrowed_samples(1)
            .max_publishers(1)
            .max_subscribers(1)
            .max_nodes(MAX_NODES);
        create_or_open!(self, builder, PublishSubscribeOpenError)
    }

    /// The service of one group's batches: one engine, its trainer and observers.
    pub(super) fn observations(&self, group: usize, limits: Limits) -> Result<ObservationService, ServiceError> {
        let builder = self
            .node
            .service_builder(&self.names.of_epoch(&format!("obs/{group}"))?)
            .publish_subscribe::<[PayloadBlock]>()
            .user_header::<ObservationHeader>()
            .enable_safe_overflow(true)
            .history_size(0)
            .subscriber_max_buffer_size(1)
            .subscriber_max_borrowed_samples(limits.batches_held)
            .max_publishers(1)
            .max_subscribers(1 + limits.observers)
            .max_nodes(MAX_NODES);
        create_or_open!(self, builder, PublishSubscribeOpenError)
    }

    /// The events of one direction; their number is the group's. `groups` is the number of groups.
    pub(super) fn events(&self, to: &str, groups: usize) -> Result<event::PortFactory<Ipc>, ServiceError> {
        let builder = self
            .node
            .service_builder(&self.names.of_epoch(to)?)
            .event()
            .event_id_max_value(groups)
            .max_listeners(1)
            .max_notifiers(1)
            .max_nodes(MAX_NODES);
        create_or_open!(self, builder, EventOpenError)
    }

    fn open_error(&self, error: &str) -> ServiceError {
        let service = self.names.service.clone();
        match error {
            "IncompatibleTypes" | "IncompatibleMessagingPattern" => ServiceError::IncompatibleTypes { service },
            "VersionMismatch" => ServiceError::Version {
                service,
                layout: "unknown".to_owned(),
                package: "with another version of iceoryx2".to_owned(),
            },
            _ => ServiceError::middleware("cannot open a service")(error.to_owned()),
        }
    }
}

/// A publisher of messages of `blocks` blocks. `resident` chunks are brought into memory right away, so that too little of it
/// is an error here and not a signal later.
pub(super) fn publisher<H: Default + std::fmt::Debug + ZeroCopySend>(
    service: &publish_subscribe::PortFactory<Ipc, [PayloadBlock], H>,
    blocks: usize,
    resident: usize,
) -> Result<(BlockPublisher<H>, Resident), PortError> {
    Resident::check_available(blocks, resident)?;
    let publisher = service
        .publisher_builder()
        .initial_max_slice_len(blocks)
        .allocation_strategy(AllocationStrategy::Static)
        .backpressure_strategy(BackpressureStrategy::DiscardData)
        // Loans in excess of one serve only to visit the chunks; they ask for no memory of their own.
        .max_loaned_samples(resident)
        .override_sample_preallocation(move |chunks| chunks - (resident - 1))
        .create()?;
    let mut memory = Resident::default();
    let mut loans = Vec::with_capacity(resident);
    for _ in 0..resident {
        Resident::check_available(blocks, 1)?;
        let mut loan = publisher
            .loan_slice_uninit(blocks)
            .map_err(|e| ServiceError::middleware("cannot lend a batch")(e.to_string()))?;
        memory.admit(loan.payload_mut())?;
        loans.push(loan);
    }
    // The list of free chunks is a stack: the first chunk is to be the next one again.
    while loans.pop().is_some() {}
    Ok((publisher, memory))
}

/// Why a port could not be made.
pub(super) enum PortError {
    /// There are as many of them as the service takes.
    Taken,
    Other(ServiceError),
}

impl From<ServiceError> for PortError {
    fn from(error: ServiceError) -> Self {
        PortError::Other(error)
    }
}

impl From<PublisherCreateError> for PortError {
    fn from(error: PublisherCreateError) -> Self {
        match error {
            PublisherCreateError::ExceedsMaxSupportedPublishers => PortError::Taken,
            e => PortError::Other(ServiceError::middleware("cannot create a publisher")(e.to_string())),
        }
    }
}

/// The port that wakes the other side.
pub(super) fn notifier(events: &event::PortFactory<Ipc>) -> Result<Notifier<Ipc>, ServiceError> {
    let failed = |e: String| ServiceError::middleware("cannot create a notifier")(e);
    events.notifier_builder().create().map_err(|e| failed(e.to_string()))
}

/// The port that this side sleeps on.
pub(super) fn listener(events: &event::PortFactory<Ipc>) -> Result<Listener<Ipc>, ServiceError> {
    let failed = |e: String| ServiceError::middleware("cannot create a listener")(e);
    events.listener_builder().create().map_err(|e| failed(e.to_string()))
}

/// Wakes the other side. That it cannot be woken is no error: it looks by itself after a while, or it is dead.
pub(super) fn notify(notifier: &Notifier<Ipc>, group: usize) {
    if let Err(e) = notifier.notify_with_custom_event_id(EventId::new(group)) {
        tracing::debug!(error = %e, group, "the other side cannot be woken");
    }
}

/// The first node among those that `list` reports.
pub(super) fn first_node(list: impl FnOnce(&mut dyn FnMut(UniqueNodeId))) -> Option<UniqueNodeId> {
    let mut first = None;
    list(&mut |node| {
        first.get_or_insert(node);
    });
    first
}

/// The node that publishes on a service.
pub(super) fn publishing_node<H: std::fmt::Debug + ZeroCopySend>(
    service: &publish_subscribe::PortFactory<Ipc, [PayloadBlock], H>,
) -> Option<UniqueNodeId> {
    first_node(|found| {
        service.dynamic_config().list_publishers(|details| {
            found(details.node_id);
            CallbackProgression::Continue
        });
    })
}

/// How long a process that removes a dead one's leftovers may take before another gives up on it.
pub(super) const CLEANUP_TIMEOUT: Duration = Duration::from_secs(1);
