//! Finding engines by their status files, which hold their specifications; see [`crate::protocol::status_file`].
//!
//! An engine owns its name as long as it has a status file of that name. It takes the name under the namespace's lock,
//! so that of two engines that start at the same time, one finds the other's file. Reading needs no lock: a file
//! appears complete and never changes its specification, and its name contains the incarnation, so that nobody removes
//! a successor's.

use std::time::Duration;

use endless_gym_core::batch::LAYOUT_VERSION;

use crate::error::ServiceError;
use crate::namespace::directory::{Namespace, check_name};
use crate::namespace::lock::NamespaceLock;
use crate::namespace::node::NamespaceNode;
use crate::protocol::specification::ServiceSpecification;
use crate::protocol::status_file::{self, StatusReader, unpadded};

/// Fails if an engine of that name is running. The result holds for as long as the lock.
pub(crate) fn refuse_second_engine(
    node: &NamespaceNode,
    service: &str,
    _lock: &NamespaceLock,
) -> Result<(), ServiceError> {
    match running(node, service) {
        Some(engine) => {
            let pid = engine.head().map(|head| head.process);
            Err(ServiceError::EngineExists { service: service.to_owned(), pid })
        }
        None => Ok(()),
    }
}

/// The specification of the running engine of that name; `None` if there is none.
pub(crate) fn read(node: &NamespaceNode, service: &str) -> Result<Option<ServiceSpecification>, ServiceError> {
    check_name(service)?;
    let Some(engine) = running(node, service) else { return Ok(None) };
    // Without a head, the engine is being removed.
    let Some(head) = engine.head() else { return Ok(None) };
    if head.layout_version != LAYOUT_VERSION {
        let (layout, package) = (head.layout_version.to_string(), unpadded(&head.package));
        return Err(ServiceError::Version { service: service.to_owned(), layout, package });
    }
    let invalid = |reason: String| ServiceError::Specification { service: service.to_owned(), reason };
    let text = engine.specification().ok_or_else(|| invalid("the file is too short".to_owned()))?;
    let specification: ServiceSpecification = serde_json::from_slice(&text).map_err(|e| invalid(e.to_string()))?;
    specification.check(service).map_err(invalid)?;
    Ok(Some(specification))
}

/// The status of the running engine of that name, of any version.
fn running(node: &NamespaceNode, service: &str) -> Option<StatusReader> {
    let named = status_file::engines(node.prefix()).into_iter().filter(|(name, _)| name == service);
    named.filter_map(|(_, path)| StatusReader::open_any(&path)).find(StatusReader::is_alive)
}

/// Names of the running engines in a namespace, sorted.
///
/// # Errors
///
/// [`ServiceError::Root`] if the namespace's directory cannot be used, and [`ServiceError::Middleware`] if iceoryx2 cannot
/// register this process.
pub fn running_engines(namespace: &Namespace) -> Result<Vec<String>, ServiceError> {
    Ok(list(&NamespaceNode::join(namespace, Duration::ZERO)?))
}

/// Names of the running engines of any version, sorted.
pub(crate) fn list(node: &NamespaceNode) -> Vec<String> {
    let mut engines = status_file::engines(node.prefix());
    engines.retain(|(_, path)| StatusReader::open_any(path).is_some_and(|engine| engine.is_alive()));
    let mut names: Vec<_> = engines.into_iter().map(|(name, _)| name).collect();
    names.sort();
    names
}
