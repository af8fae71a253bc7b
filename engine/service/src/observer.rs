//! The observer's side: watches a group without anyone noticing.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::error::ServiceError;
use super::node::Member;
use super::ports::{Names, Open, Services};
use super::received::{ObservationPort, Received};
use super::specification::Specification;
use super::trainer::{ConnectConfig, find};

/// How often a waiting observer looks.
const POLL: Duration = Duration::from_millis(1);

/// Reads a group's batches beside the trainer. The engine never waits for an observer: batches that it does not fetch in time
/// are replaced by newer ones.
pub struct Observer {
    port: Arc<ObservationPort>,
    specification: Arc<Specification>,
    node: Arc<Member>,
}

impl Observer {
    /// Watches a group of the engine that `config` names.
    pub fn connect(config: &ConnectConfig, group: usize) -> Result<Self, ServiceError> {
        let (node, port, specification) = find(config, |node, specification| {
            let (service, groups) = (specification.service.clone(), specification.groups);
            if group >= groups {
                return Err(ServiceError::NoSuchGroup { service, given: group, groups });
            }
            let names = Names::new(&service, specification.epoch);
            let services = Services { node, names, open: Open::Existing };
            ObservationPort::open(&services, node, group, specification)
        })?;
        Ok(Observer { port: Arc::new(port), specification: Arc::new(specification), node })
    }

    /// What the engine serves.
    pub fn specification(&self) -> &Specification {
        &self.specification
    }

    /// The newest batch since the last call, or none if there was no other.
    pub fn newest(&mut self) -> Result<Option<Received>, ServiceError> {
        Ok(self.port.receive(&self.specification)?.filter(Received::is_batch))
    }

    /// The next batch, waiting for it up to `timeout`.
    pub fn next(&mut self, timeout: Duration) -> Result<Received, ServiceError> {
        let start = Instant::now();
        loop {
            if let Some(received) = self.newest()? {
                return Ok(received);
            }
            let service = || self.specification.service.clone();
            if start.elapsed() >= timeout {
                return Err(if self.is_engine_alive() {
                    ServiceError::TimedOut { service: service(), waited: timeout }
                } else {
                    ServiceError::EngineLost { service: service(), pid: self.specification.engine_pid }
                });
            }
            std::thread::sleep(POLL.min(timeout));
        }
    }

    fn is_engine_alive(&self) -> bool {
        self.node.is_alive(self.port.engine())
    }
}
