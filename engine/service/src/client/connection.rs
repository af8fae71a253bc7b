//! A trainer's ports to one run of an engine.

use std::sync::Arc;
use std::time::{Duration, Instant};

use endless_gym_core::pool::Threads;
use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::port::notifier::Notifier;

use crate::client::connect::{ConnectConfig, connect_to_engine};
use crate::client::lease::ResponsePort;
use crate::error::ServiceError;
use crate::namespace::directory::Ipc;
use crate::namespace::node::NamespaceNode;
use crate::namespace::{descriptors, memory};
use crate::protocol::ports::{self, EngineServices, OpenMode, PortError, RequestPublisher};
use crate::protocol::specification::ServiceSpecification;
use crate::protocol::status_file::{self, StatusReader};
use crate::protocol::wait::Doorbell;

/// Chunks of a request publisher: one that the engine reads, one in its queue, one being written.
const REQUEST_CHUNKS: usize = 3;

/// How long a trainer waits until a dead trainer's ports are removed, by itself or by the engine.
const REMOVAL_TIMEOUT: Duration = Duration::from_secs(3);

/// How often it checks for that.
const RETRY_INTERVAL: Duration = Duration::from_millis(20);

/// A trainer's ports to one run of an engine.
pub(crate) struct EngineConnection {
    pub to_engine: Notifier<Ipc>,
    pub to_trainer: Doorbell,
    /// By group.
    pub responses: Vec<Arc<ResponsePort>>,
    /// By group. Dropped after the other ports, since the process that gets them is the next trainer.
    pub requests: Vec<RequestPublisher>,
    pub node: Arc<NamespaceNode>,
    /// The engine's status, readable even after its end; `None` if it cannot be read.
    pub status: Option<StatusReader>,
    engine: UniqueNodeId,
}

impl EngineConnection {
    /// Connects as the engine's trainer.
    pub(crate) fn open(config: &ConnectConfig) -> Result<(Self, ServiceSpecification), ServiceError> {
        let (node, (requests, responses, to_engine, to_trainer), specification) =
            connect_to_engine(config, |node, specification| {
                let services = EngineServices { node, specification, mode: OpenMode::Open };
                let groups = 0..specification.groups;
                descriptors::reserve(descriptors::of_trainer(specification.groups))?;
                // Publishers first: whoever owns the first one is the trainer.
                let requests: Vec<_> =
                    groups.clone().map(|group| request_publisher(&services, group)).collect::<Result<_, _>>()?;
                let others = || {
                    let responses = groups.clone().map(|group| response_port(&services, node, group));
                    let responses: Vec<_> = responses.collect::<Result<_, _>>()?;
                    let to_engine = ports::notifier(&services.events("to_engine")?)?;
                    let to_trainer = ports::listener(&services.events("to_trainer")?)?;
                    Ok((responses, to_engine, to_trainer))
                };
                // A dead trainer's ports are removed one by one, so these may still exist.
                let (responses, to_engine, to_trainer) = create(&services, others, || None)?;
                Ok((requests, responses, to_engine, Doorbell::new(to_trainer)))
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
fn request_publisher(services: &EngineServices<'_>, group: usize) -> Result<RequestPublisher, ServiceError> {
    let service = services.requests(group)?;
    let (blocks, threads) = (services.specification.action.blocks(), Threads::new(1)?);
    let publisher = || ports::publisher(&service, blocks, REQUEST_CHUNKS, &threads).map(|(port, _)| port);
    create(services, publisher, || ports::publisher_of(&service).map(|publisher| publisher.node_id))
}

/// The port that receives a group's responses.
fn response_port(
    services: &EngineServices<'_>,
    node: &Arc<NamespaceNode>,
    group: usize,
) -> Result<Arc<ResponsePort>, PortError> {
    ResponsePort::open(services, node, group).map(Arc::new).map_err(|e| match e {
        // Observers leave one place for the trainer.
        ServiceError::TooManyObservers { .. } => PortError::LimitReached,
        e => PortError::Other(e),
    })
}

/// Creates ports of which an engine allows one each. Waits while a dead trainer's still exist. `owner` returns the node
/// that has them, if known; if that node is running, it is another trainer.
fn create<T>(
    services: &EngineServices<'_>,
    ports: impl Fn() -> Result<T, PortError>,
    owner: impl Fn() -> Option<UniqueNodeId>,
) -> Result<T, ServiceError> {
    let start = Instant::now();
    loop {
        let creating = services.node.creating()?;
        // Checked under the lock, under which no observer can reserve memory.
        memory::check_free(memory::MARGIN)?;
        match ports() {
            Ok(ports) => return Ok(ports),
            Err(PortError::Other(e)) => return Err(e),
            Err(PortError::LimitReached) => {}
        }
        // No dead node's ports can be removed while the creation lock is held.
        drop(creating);
        let owner = owner();
        let is_alive = owner.is_some_and(|owner| services.node.is_alive(owner));
        if is_alive || start.elapsed() >= REMOVAL_TIMEOUT {
            let pid = owner.and_then(|owner| services.node.process_id_of(owner));
            return Err(ServiceError::TrainerExists { service: services.specification.service.clone(), pid });
        }
        services.node.remove_dead_nodes();
        std::thread::sleep(RETRY_INTERVAL);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use endless_gym_core::pool::PoolConfig;
    use endless_gym_memory_gym::memory_gym;

    use super::*;
    use crate::engine::config::EngineConfig;
    use crate::engine::serving::Engine;
    use crate::namespace::directory::Namespace;

    /// A dead trainer's ports are removed one by one, possibly the publishers first.
    #[test]
    fn a_trainer_waits_until_all_ports_of_a_dead_one_are_removed() {
        let namespace = Namespace::at(format!("/tmp/endless-rest-{}", std::process::id()));
        let pool = PoolConfig::new("MortarMayhem-Grid-v0", 1);
        let config = EngineConfig::new("gym", pool, 1);
        let engine = Engine::new(memory_gym(), &config.namespace(namespace.clone()).observers(0)).unwrap();
        let (to_main, ready) = channel();
        let (to_rest, end) = channel::<()>();
        let (root, specification) = (&namespace, &engine.specification().clone());
        std::thread::scope(|scope| {
            scope.spawn(move || {
                let node = Arc::new(NamespaceNode::join(root, Duration::ZERO).unwrap());
                let services = EngineServices { node: &node, specification, mode: OpenMode::Open };
                let responses = ResponsePort::open(&services, &node, 0).unwrap();
                let to_engine = ports::notifier(&services.events("to_engine").unwrap()).unwrap();
                let to_trainer = ports::listener(&services.events("to_trainer").unwrap()).unwrap();
                to_main.send(()).unwrap();
                end.recv().unwrap();
                for rest in [Box::new(responses) as Box<dyn std::any::Any>, Box::new(to_engine), Box::new(to_trainer)] {
                    std::thread::sleep(2 * RETRY_INTERVAL);
                    drop(rest);
                }
            });
            ready.recv().unwrap();
            to_rest.send(()).unwrap();
            let config = ConnectConfig::new("gym").namespace(namespace.clone());
            EngineConnection::open(&config).map(drop).unwrap();
        });
        drop(engine);
        std::fs::remove_dir_all(namespace.root()).unwrap();
    }
}
