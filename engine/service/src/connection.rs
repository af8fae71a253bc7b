//! A trainer's ports to one run of an engine.

use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;

use crate::connect::{ConnectConfig, connect_to_engine};
use crate::descriptors;
use crate::error::ServiceError;
use crate::lease::ResponsePort;
use crate::namespace::Ipc;
use crate::node::NamespaceNode;
use crate::ports::{self, EngineServices, OpenMode, PortError, RequestPublisher, ServiceNames};
use crate::specification::ServiceSpecification;
use crate::status_file::{self, StatusReader};

/// Chunks of a request publisher: one that the engine reads, one in its queue, one being written.
const REQUEST_CHUNKS: usize = 3;

/// How long a trainer waits for the removal of a dead trainer's ports, which is the engine's work if it cannot do it itself.
const REMOVAL_TIMEOUT: Duration = Duration::from_secs(3);

/// How often it looks.
const RETRY_INTERVAL: Duration = Duration::from_millis(20);

/// A trainer's ports to one run of an engine.
pub(crate) struct EngineConnection {
    /// By group.
    pub requests: Vec<RequestPublisher>,
    /// By group.
    pub responses: Vec<Arc<ResponsePort>>,
    pub to_engine: Notifier<Ipc>,
    pub to_trainer: Listener<Ipc>,
    pub node: Arc<NamespaceNode>,
    /// The engine's status, also after its end; `None` if it cannot be read.
    pub status: Option<StatusReader>,
    engine: UniqueNodeId,
}

impl EngineConnection {
    /// Connects as the engine's trainer.
    pub(crate) fn open(config: &ConnectConfig) -> Result<(Self, ServiceSpecification), ServiceError> {
        let (node, (requests, responses, to_engine, to_trainer), specification) =
            connect_to_engine(config, |node, specification| {
                let names = ServiceNames::new(&specification.service, specification.incarnation);
                let services = EngineServices { node, names, mode: OpenMode::Open };
                let groups = 0..specification.groups;
                descriptors::reserve(descriptors::of_trainer(specification.groups))?;
                // The owner of the first publisher is the trainer, so the publishers come first.
                let requests: Vec<_> = groups
                    .clone()
                    .map(|group| request_publisher(&services, group, specification))
                    .collect::<Result<_, _>>()?;
                let _creating = node.creating()?;
                let responses: Vec<_> = groups
                    .map(|group| ResponsePort::open(&services, node, group, specification).map(Arc::new))
                    .collect::<Result<_, _>>()?;
                let to_engine = ports::notifier(&services.events("to_engine", specification.groups)?)?;
                let to_trainer = ports::listener(&services.events("to_trainer", specification.groups)?)?;
                Ok((requests, responses, to_engine, to_trainer))
            })?;
        // A valid specification has at least one group.
        let engine = responses[0].engine();
        let status = status_file::path(node.prefix(), &specification.service, specification.incarnation);
        let status = StatusReader::open(&status);
        Ok((EngineConnection { requests, responses, to_engine, to_trainer, node, status, engine }, specification))
    }

    /// Whether the engine's process is running.
    pub(crate) fn is_engine_alive(&self) -> bool {
        self.node.is_alive(self.engine)
    }
}

/// The port that makes a process the trainer of a group.
fn request_publisher(
    services: &EngineServices<'_>,
    group: usize,
    specification: &ServiceSpecification,
) -> Result<RequestPublisher, ServiceError> {
    let start = Instant::now();
    loop {
        let creating = services.node.creating()?;
        let service = services.requests(group)?;
        match ports::publisher(&service, specification.action.blocks(), REQUEST_CHUNKS) {
            Ok((publisher, _)) => return Ok(publisher),
            Err(PortError::Other(e)) => return Err(e),
            Err(PortError::LimitReached) => {}
        }
        // The port of a dead trainer exists until a process removes it. While this process creates ports, it cannot.
        drop(creating);
        let owner = ports::publisher_node(&service);
        let is_alive = owner.is_some_and(|owner| services.node.is_alive(owner));
        if is_alive || start.elapsed() >= REMOVAL_TIMEOUT {
            let pid = owner.and_then(|owner| services.node.process_id_of(owner));
            return Err(ServiceError::TrainerExists { service: specification.service.clone(), pid });
        }
        services.node.remove_dead_nodes();
        std::thread::sleep(RETRY_INTERVAL);
    }
}
