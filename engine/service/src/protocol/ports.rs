//! The iceoryx2 services and ports of an engine.

use endless_gym_core::batch::{Layout, SNAPSHOT_BYTES, blocks_for};
use endless_gym_core::pool::Threads;
use iceoryx2::port::listener::{Listener, ListenerCreateError};
use iceoryx2::port::notifier::{Notifier, NotifierCreateError};
use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{
    AllocationStrategy, BackpressureStrategy, CallbackProgression, EventId, PortFactory, ServiceName, ZeroCopySend,
};
use iceoryx2::service::builder::event::EventOpenError;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use iceoryx2::service::dynamic_config::publish_subscribe::PublisherDetails;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use crate::error::ServiceError;
use crate::namespace::directory::Ipc;
use crate::namespace::memory::PrefaultedChunks;
use crate::namespace::node::NamespaceNode;
use crate::protocol::message::{PayloadBlock, RequestHeader, ResponseHeader};
use crate::protocol::specification::ServiceSpecification;

pub(crate) type BlockService<H> = publish_subscribe::PortFactory<Ipc, [PayloadBlock], H>;
pub(crate) type BlockPublisher<H> = Publisher<Ipc, [PayloadBlock], H>;
pub(crate) type RequestPublisher = BlockPublisher<RequestHeader>;
pub(crate) type RequestSubscriber = Subscriber<Ipc, [PayloadBlock], RequestHeader>;
pub(crate) type ResponsePublisher = BlockPublisher<ResponseHeader>;
pub(crate) type ResponseSubscriber = Subscriber<Ipc, [PayloadBlock], ResponseHeader>;

/// Nodes that may open a service at a time: the engine, its trainer, observers, and processes that are about to be refused.
const MAX_NODES: usize = 64;

/// Name of the port of an observer that resumed after a pause. Other ports have no name.
pub(crate) const RESUMED: &str = "resumed";

/// Prefix of the names of all services.
pub(crate) const SERVICE_PREFIX: &str = "endless-gym/";

/// Blocks of a chunk that can hold a batch or a snapshot.
pub(crate) fn chunk_blocks(batch: &Layout) -> usize {
    batch.blocks().max(blocks_for(SNAPSHOT_BYTES))
}

/// Whether services are created or opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum OpenMode {
    Create,
    Open,
}

/// Creates or opens the services of one engine.
pub(crate) struct EngineServices<'a> {
    pub node: &'a NamespaceNode,
    pub specification: &'a ServiceSpecification,
    pub mode: OpenMode,
}

impl EngineServices<'_> {
    /// The name of a service. It contains the incarnation, so that a restarted engine shares no service with a dead one.
    fn name(&self, what: &str) -> Result<ServiceName, ServiceError> {
        let ServiceSpecification { service, incarnation, .. } = self.specification;
        let text = format!("{SERVICE_PREFIX}{service}/{incarnation:016x}/{what}");
        ServiceName::new(&text).map_err(ServiceError::middleware("cannot create a service name"))
    }

    /// The service of one group's requests: from one trainer to one engine.
    pub(crate) fn requests(&self, group: usize) -> Result<BlockService<RequestHeader>, ServiceError> {
        self.block_service(&format!("act/{group}"), 1, 1)
    }

    /// The service of one group's responses: from one engine to its trainer and observers.
    pub(crate) fn responses(&self, group: usize) -> Result<BlockService<ResponseHeader>, ServiceError> {
        let ServiceSpecification { batches_held, observers, .. } = *self.specification;
        self.block_service(&format!("obs/{group}"), batches_held, 1 + observers)
    }

    /// A service with one publisher and `subscribers` subscribers, each of which may borrow `borrowed` samples.
    fn block_service<H: Default + std::fmt::Debug + ZeroCopySend>(
        &self,
        name: &str,
        borrowed: usize,
        subscribers: usize,
    ) -> Result<BlockService<H>, ServiceError> {
        let builder = self
            .node
            .service_builder(&self.name(name)?)
            .publish_subscribe::<[PayloadBlock]>()
            .user_header::<H>()
            .enable_safe_overflow(true)
            .history_size(0)
            .subscriber_max_buffer_size(1)
            .subscriber_max_borrowed_samples(borrowed)
            .max_publishers(1)
            .max_subscribers(subscribers)
            .max_nodes(MAX_NODES);
        match self.mode {
            OpenMode::Create => builder.create().map_err(ServiceError::middleware("cannot create a service")),
            OpenMode::Open => builder.open().map_err(|e| block_error(&self.specification.service, e)),
        }
    }

    /// The events of one direction. The id of an event is the number of a group, or the number of groups for any.
    pub(crate) fn events(&self, to: &str) -> Result<event::PortFactory<Ipc>, ServiceError> {
        let builder = self
            .node
            .service_builder(&self.name(to)?)
            .event()
            .event_id_max_value(self.specification.groups)
            .max_listeners(1)
            // The other side's; and the engine's, which wakes its own threads.
            .max_notifiers(2)
            .max_nodes(MAX_NODES);
        match self.mode {
            OpenMode::Create => builder.create().map_err(ServiceError::middleware("cannot create a service")),
            OpenMode::Open => builder.open().map_err(|e| event_error(&self.specification.service, e)),
        }
    }
}

/// Defines `function`, which converts an error of opening a service of the engine `service`; `other_type` are the variants for
/// messages of another type.
macro_rules! open_error {
    ($function:ident, $error:ident, $($other_type:ident)|+) => {
        fn $function(service: &str, error: $error) -> ServiceError {
            use $error as E;
            let service = service.to_owned();
            match error {
                // It does not exist, or it is being removed.
                E::DoesNotExist | E::IsMarkedForDestruction | E::HangsInCreation | E::ServiceInCorruptedState => {
                    ServiceError::EngineRestarted { service }
                }
                $(E::$other_type)|+ => ServiceError::IncompatibleTypes { service },
                E::VersionMismatch => {
                    let package = "with another version of iceoryx2".to_owned();
                    ServiceError::Version { service, layout: "unknown".to_owned(), package }
                }
                e => ServiceError::middleware("cannot open a service")(e),
            }
        }
    };
}

open_error!(block_error, PublishSubscribeOpenError, IncompatibleTypes | IncompatibleMessagingPattern);
open_error!(event_error, EventOpenError, IncompatibleMessagingPattern);

/// A publisher of messages of `blocks` blocks. Prefaults `prefaulted` chunks by `threads`, so that missing memory is an error here and
/// not a SIGBUS later.
pub(crate) fn publisher<H: Default + std::fmt::Debug + ZeroCopySend>(
    service: &BlockService<H>,
    blocks: usize,
    prefaulted: usize,
    threads: &Threads,
) -> Result<(BlockPublisher<H>, PrefaultedChunks), PortError> {
    PrefaultedChunks::check_available(blocks, prefaulted)?;
    let publisher = service
        .publisher_builder()
        .initial_max_slice_len(blocks)
        .allocation_strategy(AllocationStrategy::Static)
        .backpressure_strategy(BackpressureStrategy::DiscardData)
        // More than one loan is needed only to prefault the chunks below, so the extra loans get no additional chunks.
        .max_loaned_samples(prefaulted)
        .override_sample_preallocation(move |chunks| chunks - (prefaulted - 1))
        .create()?;
    let mut memory = PrefaultedChunks::new(threads);
    let mut loans = Vec::with_capacity(prefaulted);
    for _ in 0..prefaulted {
        PrefaultedChunks::check_available(blocks, 1)?;
        let mut loan = publisher.loan_slice_uninit(blocks).map_err(ServiceError::middleware("cannot loan a chunk"))?;
        memory.prefault(loan.payload_mut())?;
        loans.push(loan);
    }
    // The list of free chunks is a stack: return them in reverse order, so that the first chunk is on top again.
    while loans.pop().is_some() {}
    Ok((publisher, memory))
}

/// Why a port could not be created.
#[derive(Debug)]
pub(crate) enum PortError {
    /// The service already has its maximum number of such ports.
    LimitReached,
    Other(ServiceError),
}

impl From<ServiceError> for PortError {
    fn from(error: ServiceError) -> Self {
        PortError::Other(error)
    }
}

/// Tells a reached limit from the other errors of creating a port.
macro_rules! port_error {
    ($error:ident, $limit:ident, $action:literal) => {
        impl From<$error> for PortError {
            fn from(error: $error) -> Self {
                match error {
                    $error::$limit => PortError::LimitReached,
                    e => PortError::Other(ServiceError::middleware($action)(e)),
                }
            }
        }
    };
}

port_error!(PublisherCreateError, ExceedsMaxSupportedPublishers, "cannot create a publisher");
port_error!(NotifierCreateError, ExceedsMaxSupportedNotifiers, "cannot create a notifier");
port_error!(ListenerCreateError, ExceedsMaxSupportedListeners, "cannot create a listener");

/// For ports that no other process can have.
impl From<PortError> for ServiceError {
    fn from(error: PortError) -> Self {
        match error {
            PortError::Other(e) => e,
            PortError::LimitReached => ServiceError::middleware("cannot create a port")("it exists already"),
        }
    }
}

/// The port that wakes the waiter of the other process.
pub(crate) fn notifier(events: &event::PortFactory<Ipc>) -> Result<Notifier<Ipc>, PortError> {
    Ok(events.notifier_builder().create()?)
}

/// The port that this process parks on.
pub(crate) fn listener(events: &event::PortFactory<Ipc>) -> Result<Listener<Ipc>, PortError> {
    Ok(events.listener_builder().create()?)
}

/// Wakes the waiter of the other process. A failure is not an error: a waiter also polls after a timeout.
pub(crate) fn notify(notifier: &Notifier<Ipc>, group: usize) {
    if let Err(e) = notifier.notify_with_custom_event_id(EventId::new(group)) {
        tracing::debug!(error = %e, group, "cannot notify the other process");
    }
}

/// The publisher of a service.
pub(crate) fn publisher_of<H: std::fmt::Debug + ZeroCopySend>(service: &BlockService<H>) -> Option<PublisherDetails> {
    let mut publisher = None;
    service.dynamic_config().list_publishers(|details| {
        publisher = Some(*details);
        CallbackProgression::Stop
    });
    publisher
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn open_errors_are_told_apart_by_their_variant() {
        use PublishSubscribeOpenError as E;
        let of = |error| block_error("gym", error);
        assert!(matches!(of(E::IncompatibleTypes), ServiceError::IncompatibleTypes { .. }));
        assert!(matches!(of(E::VersionMismatch), ServiceError::Version { .. }));
        assert!(matches!(of(E::HangsInCreation), ServiceError::EngineRestarted { .. }));
        assert!(matches!(of(E::ExceedsMaxNumberOfNodes), ServiceError::Middleware { .. }));
        let of = |error| event_error("gym", error);
        assert!(matches!(of(EventOpenError::IncompatibleMessagingPattern), ServiceError::IncompatibleTypes { .. }));
        assert!(matches!(of(EventOpenError::VersionMismatch), ServiceError::Version { .. }));
    }
}
