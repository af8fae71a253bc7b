//! Finding an engine by its name.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::error::ServiceError;
use crate::namespace::directory::Namespace;
use crate::namespace::node::NamespaceNode;
use crate::namespace::{descriptors, memory};
use crate::protocol::discovery;
use crate::protocol::specification::ServiceSpecification;

/// How often a process looks for an engine that is not running yet.
const RETRY_INTERVAL: Duration = Duration::from_millis(20);

/// How long a process waits at least for an engine that is starting or ending.
const TRANSITION_TIMEOUT: Duration = Duration::from_secs(1);

/// The engine to which a trainer or an observer connects.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct ConnectConfig {
    /// The engine's name.
    pub service: String,
    /// The engine's namespace.
    pub namespace: Namespace,
    /// How long to wait for an engine of that name. With a timeout of zero the engine must be running.
    pub timeout: Duration,
}

impl ConnectConfig {
    /// The engine `service` in the default namespace, with a timeout of zero.
    pub fn new(service: &str) -> Self {
        ConnectConfig { service: service.to_owned(), namespace: Namespace::default(), timeout: Duration::ZERO }
    }

    endless_gym_core::setters!(service: String, namespace: Namespace, timeout: Duration);
}

/// Converts a timeout in seconds. Timeouts beyond [`Duration::MAX`] become [`Duration::MAX`].
///
/// # Errors
///
/// [`ServiceError::InvalidTimeout`] if the timeout is negative, infinite or NaN.
///
/// ```
/// use std::time::Duration;
///
/// use endless_gym_service::timeout_from_seconds;
///
/// assert_eq!(timeout_from_seconds(0.5).unwrap(), Duration::from_millis(500));
/// assert_eq!(timeout_from_seconds(1e300).unwrap(), Duration::MAX);
/// assert_eq!(timeout_from_seconds(-1.0).unwrap_err().to_string(), "timeout must be finite and not negative, got -1");
/// ```
pub fn timeout_from_seconds(seconds: f64) -> Result<Duration, ServiceError> {
    if seconds.is_finite() && seconds >= 0.0 {
        Ok(Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX))
    } else {
        Err(ServiceError::InvalidTimeout { given: seconds })
    }
}

/// Joins the namespace and calls `connect` with the engine's specification until it succeeds or the timeout has passed.
pub(crate) fn connect_to_engine<T>(
    config: &ConnectConfig,
    connect: impl Fn(&Arc<NamespaceNode>, &ServiceSpecification) -> Result<T, ServiceError>,
) -> Result<(Arc<NamespaceNode>, T, ServiceSpecification), ServiceError> {
    let start = Instant::now();
    // For one group: how many the engine has is known later.
    descriptors::reserve(descriptors::of_trainer(1))?;
    let node = Arc::new(NamespaceNode::join(&config.namespace, config.timeout)?);
    // Joining may have taken longer than a transition.
    let joined = Instant::now();
    loop {
        let result = find(&node, config).and_then(|specification| {
            memory::check_free(memory::MARGIN)?;
            connect(&node, &specification).map(|ports| (ports, specification))
        });
        let is_waiting = match &result {
            // The engine is not running yet, or it was replaced while this process connected.
            Err(ServiceError::UnknownEngine { .. } | ServiceError::EngineRestarted { .. }) => {
                start.elapsed() < config.timeout
            }
            Err(ServiceError::EngineUnreachable { .. }) => {
                start.elapsed() < config.timeout || joined.elapsed() < TRANSITION_TIMEOUT
            }
            _ => false,
        };
        match result {
            Ok((ports, specification)) => return Ok((node, ports, specification)),
            Err(_) if is_waiting => {
                node.remove_dead_nodes();
                std::thread::sleep(RETRY_INTERVAL);
            }
            Err(e) => return Err(e),
        }
    }
}

/// The specification of the engine.
fn find(node: &NamespaceNode, config: &ConnectConfig) -> Result<ServiceSpecification, ServiceError> {
    let service = config.service.clone();
    if let Some(specification) = discovery::read(node, &service)? {
        return Ok(specification);
    }
    let running = discovery::list(node);
    if running.contains(&service) {
        // The engine started after the first look-up, or it is ending.
        return Err(ServiceError::EngineUnreachable { service });
    }
    Err(ServiceError::UnknownEngine { service, root: config.namespace.root().to_owned(), running })
}
