//! Publication and discovery of specifications.
//!
//! An engine publishes its specification on a blackboard, an iceoryx2 service that stores values and can be read at any time. The
//! service's name contains nothing but the engine's name, so an engine owns its name as long as it owns the service. The value is JSON text in
//! pieces of a fixed size, preceded by a head whose form is the same in all versions: a reader recognises an engine of another
//! version before it reads anything else.
//!
//! Everything that creates, opens or removes such a service holds the namespace's lock; see [`crate::namespace::lock`].

use std::path::PathBuf;
use std::time::{Duration, Instant};

use endless_gym_core::batch::LAYOUT_VERSION;
use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::port::writer::Writer;
use iceoryx2::prelude::{
    CallbackProgression, MessagingPattern as MessagingPatternKind, NodeState, PortFactory, Service, ServiceName,
    ZeroCopySend,
};
use iceoryx2::service::builder::blackboard::{BlackboardCreateError, BlackboardOpenError};
use iceoryx2::service::port_factory::blackboard;
use iceoryx2::service::static_config::messaging_pattern::MessagingPattern;

use crate::error::{PACKAGE_VERSION, ServiceError};
use crate::namespace::directory::{Ipc, Namespace, check_name};
use crate::namespace::lock::{LOCK_TIMEOUT, NamespaceLock};
use crate::namespace::node::NamespaceNode;
use crate::protocol::ports::{self, SPECIFICATION_PREFIX, ServiceNames};
use crate::protocol::specification::ServiceSpecification;

/// How long an engine waits for the regular removal of what a dead engine left under its name.
const REMOVAL_TIMEOUT: Duration = Duration::from_secs(1);

/// How long an engine tries to take its name from a dead engine.
const PUBLISH_TIMEOUT: Duration = Duration::from_secs(3);

/// How often it tries.
const RETRY_INTERVAL: Duration = Duration::from_millis(5);

/// How to read the remaining values. Its form must never change.
#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("endless_gym::SpecificationHead")]
#[repr(C)]
struct SpecificationHead {
    layout_version: u32,
    /// Length of the JSON text in bytes.
    length: u32,
    /// Version of the engine's package, padded with zeros.
    package: [u8; 32],
}

const PIECE_BYTES: usize = 4096;

#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("endless_gym::SpecificationPiece")]
#[repr(C)]
struct SpecificationPiece([u8; PIECE_BYTES]);

/// Key of the head. The keys of the pieces follow.
const HEAD_KEY: u32 = 0;

type Board = blackboard::PortFactory<Ipc, u32>;

/// A published specification. The engine holds its name until this is dropped.
#[derive(Debug)]
pub(crate) struct PublishedSpecification {
    board: Option<(Writer<Ipc, u32>, Board)>,
    root: PathBuf,
}

impl Drop for PublishedSpecification {
    fn drop(&mut self) {
        // Closing the board removes the service by its name, which must not be a successor's by then.
        let lock = NamespaceLock::acquire_within(&self.root, LOCK_TIMEOUT);
        if let Err(e) = &lock {
            tracing::warn!(error = %e, "the specification is removed without the lock");
        }
        drop(self.board.take());
    }
}

/// Publishes the specification and thereby takes the engine's name. Returns the lock as well, without which no other process can
/// find the engine yet.
pub(crate) fn publish(
    node: &NamespaceNode,
    specification: &ServiceSpecification,
) -> Result<(NamespaceLock, PublishedSpecification), ServiceError> {
    let failed = ServiceError::middleware("cannot publish the specification");
    let text = serde_json::to_vec(specification).map_err(|e| failed(e.to_string()))?;
    let name = ServiceNames::specification(&specification.service)?;
    let mut blocked_since = None;
    loop {
        let lock = node.lock()?;
        if let Some(published) = create(node, &name, &text)? {
            return Ok((lock, published));
        }
        refuse_second_engine(node, &specification.service, &lock)?;
        // No engine that holds the name is running, and none can take it while this process holds the lock.
        let waited = blocked_since.get_or_insert_with(Instant::now).elapsed();
        if waited >= PUBLISH_TIMEOUT {
            return Err(ServiceError::EngineExists { service: specification.service.clone(), pid: None });
        }
        if waited >= REMOVAL_TIMEOUT {
            // SAFETY: no other process uses the service. Its engine is dead, as checked above, and readers and other engines open
            // it only while they hold the lock, which this process holds from before the check until after the removal.
            let removed = unsafe { node.force_remove_service(&name, MessagingPatternKind::Blackboard) };
            removed.map_err(|e| failed(e.to_string()))?;
        }
        node.clean(&lock);
        drop(lock);
        std::thread::sleep(RETRY_INTERVAL);
    }
}

/// Creates the blackboard; `None` if its name is taken.
fn create(
    node: &NamespaceNode,
    name: &ServiceName,
    text: &[u8],
) -> Result<Option<PublishedSpecification>, ServiceError> {
    let failed = ServiceError::middleware("cannot publish the specification");
    let mut package = [0; 32];
    package.iter_mut().zip(PACKAGE_VERSION.bytes()).for_each(|(to, from)| *to = from);
    let length = u32::try_from(text.len()).map_err(|e| failed(e.to_string()))?;
    let head = SpecificationHead { layout_version: LAYOUT_VERSION, length, package };
    let mut creator = node.service_builder(name).blackboard_creator::<u32>().add(HEAD_KEY, head);
    for (key, bytes) in (HEAD_KEY + 1..).zip(text.chunks(PIECE_BYTES)) {
        let mut piece = SpecificationPiece([0; PIECE_BYTES]);
        piece.0[..bytes.len()].copy_from_slice(bytes);
        creator = creator.add(key, piece);
    }
    match creator.max_readers(64).max_nodes(64).create() {
        Ok(board) => {
            let writer = board.writer_builder().create().map_err(|e| failed(e.to_string()))?;
            Ok(Some(PublishedSpecification { board: Some((writer, board)), root: node.root().to_owned() }))
        }
        Err(
            BlackboardCreateError::AlreadyExists
            | BlackboardCreateError::IsBeingCreatedByAnotherInstance
            | BlackboardCreateError::HangsInCreation
            | BlackboardCreateError::ServiceInCorruptedState,
        ) => Ok(None),
        Err(e) => Err(failed(e.to_string())),
    }
}

/// Fails if an engine of that name is running. The result holds for as long as the lock.
pub(crate) fn refuse_second_engine(
    node: &NamespaceNode,
    service: &str,
    _lock: &NamespaceLock,
) -> Result<(), ServiceError> {
    let Some(board) = open(node, service)? else { return Ok(()) };
    match writer_node(&board) {
        Some(owner) if node.is_alive(owner) => {
            let pid = node.process_id_of(owner);
            Err(ServiceError::EngineExists { service: service.to_owned(), pid })
        }
        _ => Ok(()),
    }
}

/// Opens the blackboard of that name; `None` if there is none that is complete.
fn open(node: &NamespaceNode, service: &str) -> Result<Option<Board>, ServiceError> {
    let name = ServiceNames::specification(service)?;
    match node.service_builder(&name).blackboard_opener::<u32>().open() {
        Ok(board) => Ok(Some(board)),
        Err(
            BlackboardOpenError::DoesNotExist
            | BlackboardOpenError::IsMarkedForDestruction
            | BlackboardOpenError::HangsInCreation
            | BlackboardOpenError::ServiceInCorruptedState,
        ) => Ok(None),
        Err(BlackboardOpenError::VersionMismatch) => Err(ServiceError::other_iceoryx2(service)),
        Err(e) => Err(ServiceError::middleware("cannot open the specification")(e.to_string())),
    }
}

/// The engine's node.
fn writer_node(board: &Board) -> Option<UniqueNodeId> {
    ports::first_node(|found| {
        board.dynamic_config().list_writers(|details| {
            found(details.node_id);
            CallbackProgression::Continue
        });
    })
}

/// Reads the specification of the running engine of that name; `None` if there is none.
pub(crate) fn read(node: &NamespaceNode, service: &str) -> Result<Option<ServiceSpecification>, ServiceError> {
    check_name(service)?;
    read_locked(node, service, &node.lock()?)
}

/// Like [`read`], for a caller that holds the lock.
pub(crate) fn read_locked(
    node: &NamespaceNode,
    service: &str,
    _lock: &NamespaceLock,
) -> Result<Option<ServiceSpecification>, ServiceError> {
    let invalid = |reason: String| ServiceError::Specification { service: service.to_owned(), reason };
    let Some(board) = open(node, service)? else { return Ok(None) };
    if !writer_node(&board).is_some_and(|writer| node.is_alive(writer)) {
        return Ok(None);
    }
    let reader = board.reader_builder().create();
    let reader = reader.map_err(|e| ServiceError::middleware("cannot read the specification")(e.to_string()))?;
    let head = *reader.entry::<SpecificationHead>(&HEAD_KEY).map_err(|e| invalid(e.to_string()))?.get();
    if head.layout_version != LAYOUT_VERSION {
        let package = String::from_utf8_lossy(&head.package).trim_end_matches('\0').to_owned();
        let layout = head.layout_version.to_string();
        return Err(ServiceError::Version { service: service.to_owned(), layout, package });
    }
    let mut text = Vec::new();
    for key in HEAD_KEY + 1..=head.length.div_ceil(PIECE_BYTES as u32) {
        let piece = reader.entry::<SpecificationPiece>(&key).map_err(|e| invalid(e.to_string()))?.get();
        text.extend_from_slice(&piece.0);
    }
    text.truncate(head.length as usize);
    let specification: ServiceSpecification = serde_json::from_slice(&text).map_err(|e| invalid(e.to_string()))?;
    specification.check(service).map_err(invalid)?;
    Ok(Some(specification))
}

/// Names of the running engines in a namespace, sorted.
///
/// # Errors
///
/// [`ServiceError::Root`] if the namespace's directory cannot be used, and [`ServiceError::Middleware`] if iceoryx2 cannot
/// register this process or list the services.
pub fn running_engines(namespace: &Namespace) -> Result<Vec<String>, ServiceError> {
    list(&NamespaceNode::join(namespace, Duration::ZERO)?)
}

/// Names of the running engines, sorted.
pub(crate) fn list(node: &NamespaceNode) -> Result<Vec<String>, ServiceError> {
    let mut names = published_names(node)?;
    if !names.is_empty() {
        let _lock = node.lock()?;
        names.retain(|name| match open(node, name) {
            Ok(board) => board.as_ref().and_then(writer_node).is_some_and(|engine| node.is_alive(engine)),
            // Such as an engine of another version.
            Err(_) => true,
        });
    }
    Ok(names)
}

/// Names of the specifications that a running process uses, sorted: also of those of dead engines that another process reads.
/// Needs no lock, because it opens no service.
fn published_names(node: &NamespaceNode) -> Result<Vec<String>, ServiceError> {
    let mut names = Vec::new();
    let listed = Ipc::list(node.config(), |service| {
        let name = service.static_details.name().as_str();
        let is_alive = |node: &NodeState<Ipc>| matches!(node, NodeState::Alive(_));
        if let (MessagingPattern::Blackboard(_), Some(name)) =
            (service.static_details.messaging_pattern(), name.strip_prefix(SPECIFICATION_PREFIX))
            && service.dynamic_details.is_some_and(|details| details.nodes.iter().any(is_alive))
        {
            names.push(name.to_owned());
        }
        CallbackProgression::Continue
    });
    listed.map_err(|e| ServiceError::middleware("cannot list the engines")(e.to_string()))?;
    names.sort();
    Ok(names)
}

#[cfg(test)]
mod tests {
    use endless_gym_core::pool::PoolConfig;

    use super::*;
    use crate::{Engine, EngineConfig};

    #[test]
    fn publication_waits_for_the_lock() {
        let namespace = Namespace::at(format!("/tmp/endless-publish-{}", std::process::id()));
        let pool = PoolConfig::new("MortarMayhem-Grid-v0", 1);
        let config = EngineConfig::new("model", pool, 1);
        let engine = Engine::new(&EngineConfig { namespace: namespace.clone(), ..config }).unwrap();
        let specification = ServiceSpecification { service: "gym".to_owned(), ..engine.specification().clone() };
        let node = NamespaceNode::join(&namespace, Duration::ZERO).unwrap();
        let lock = node.lock().unwrap();
        std::thread::scope(|scope| {
            let publication = scope.spawn(|| publish(&node, &specification));
            std::thread::sleep(Duration::from_millis(200));
            assert_eq!(published_names(&node).unwrap(), ["model"]);
            drop(lock);
            let (lock, published) = publication.join().unwrap().unwrap();
            drop(lock);
            assert_eq!(list(&node).unwrap(), ["gym", "model"]);
            drop(published);
        });
        drop((node, engine));
        std::fs::remove_dir_all(namespace.root()).unwrap();
    }
}
