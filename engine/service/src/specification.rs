//! What a trainer has to know about an engine, and how it learns it from nothing but the engine's name.
//!
//! The engine puts its specification on a blackboard: a service that keeps values and that can be read at any time. The text
//! is JSON in pieces of fixed size, behind a head whose form is the same in all versions, so that a version that does not fit
//! is recognised before anything else is read.

use std::time::{Duration, Instant};

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::port::writer::Writer;
use iceoryx2::prelude::{
    CallbackProgression, MessagingPattern as MessagingPatternKind, NodeState, PortFactory, Service, ZeroCopySend,
};
use iceoryx2::service::builder::blackboard::{BlackboardCreateError, BlackboardOpenError};
use iceoryx2::service::port_factory::blackboard;
use iceoryx2::service::static_config::messaging_pattern::MessagingPattern;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value as Json};

use super::config::{Namespace, check_name};
use super::error::{PACKAGE_VERSION, ServiceError};
use super::node::{Ipc, Member};
use super::ports::{self, CLEANUP_TIMEOUT, Limits, Names, SPECIFICATION_PREFIX};
use super::sweep;
use endless_gym_core::batch::{ActionLayout, Frames, LAYOUT_VERSION, Layout};
use endless_gym_core::envs::ActionSpace;
use endless_gym_core::pool::Autoreset;

/// Everything that a trainer or an observer needs to know about an engine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Specification {
    /// The engine's name.
    pub service: String,
    pub layout_version: u32,
    /// Version of the engine's package.
    pub engine_version: String,
    pub engine_pid: u32,
    /// Drawn anew at each start of an engine.
    pub epoch: u64,
    /// Environment id.
    pub id: String,
    /// Groups that are stepped independently of each other.
    pub groups: usize,
    /// Environments in each group.
    pub num_envs: usize,
    /// The layout of a group's batch.
    pub batch: Layout,
    /// The layout of the message that steps or resets a group.
    pub action: ActionLayout,
    /// What the frames in a batch look like, if it has any.
    pub frames: Option<Frames>,
    pub action_space: ActionSpace,
    /// Names of the columns of `info`.
    pub info: Vec<String>,
    /// Names of the columns of `features`.
    pub features: Vec<String>,
    /// Reset parameters that were given: one set for all environments, or one for each of all groups.
    pub options: Vec<Map<String, Json>>,
    pub autoreset: Autoreset,
    /// Frames a second at which a person would watch.
    pub render_fps: u32,
    /// Batches of a group that a trainer may hold at a time.
    pub batches_held: usize,
    /// Observers that may watch at a time.
    pub observers: usize,
}

impl Specification {
    pub(super) fn limits(&self) -> Limits {
        Limits { batches_held: self.batches_held, observers: self.observers }
    }

    /// The first thing in which another engine differs such that a trainer of this one cannot go on with it.
    pub(super) fn difference(&self, other: &Specification) -> Option<&'static str> {
        let same = [
            ("environment", self.id == other.id),
            ("number of groups", self.groups == other.groups),
            ("number of environments", self.num_envs == other.num_envs),
            ("batch layout", self.batch == other.batch && self.action == other.action && self.frames == other.frames),
            ("action space", self.action_space == other.action_space),
            ("set of columns", self.info == other.info && self.features == other.features),
            ("set of options", self.options == other.options),
            ("auto-reset mode", self.autoreset == other.autoreset),
        ];
        same.into_iter().find(|(_, same)| !same).map(|(what, _)| what)
    }
}

/// Says how to read the rest. Its form never changes.
#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("endless_gym::SpecificationHead")]
#[repr(C)]
struct Head {
    layout_version: u32,
    /// Bytes of the JSON text.
    length: u32,
    /// Version of the engine's package, padded with zeros.
    package: [u8; 32],
}

const PIECE_BYTES: usize = 4096;

#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("endless_gym::SpecificationPiece")]
#[repr(C)]
struct Piece([u8; PIECE_BYTES]);

/// Key of the head; the pieces follow.
const HEAD: u32 = 0;

/// The engine's side: holds the name for as long as it lives.
#[derive(Debug)]
pub(super) struct Published {
    _writer: Writer<Ipc, u32>,
    _board: blackboard::PortFactory<Ipc, u32>,
}

/// Publishes the specification, and with it takes the name.
pub(super) fn publish(node: &Member, specification: &Specification) -> Result<Published, ServiceError> {
    let failed = ServiceError::middleware("cannot publish the specification");
    let text = serde_json::to_vec(specification).map_err(|e| failed(e.to_string()))?;
    let mut package = [0; 32];
    package.iter_mut().zip(PACKAGE_VERSION.bytes()).for_each(|(to, from)| *to = from);
    let length = u32::try_from(text.len()).map_err(|e| failed(e.to_string()))?;
    let head = Head { layout_version: LAYOUT_VERSION, length, package };
    let name = Names::specification(&specification.service)?;
    let start = Instant::now();
    let mut forced = false;
    loop {
        let mut creator = node.service_builder(&name).blackboard_creator::<u32>().add(HEAD, head);
        for (key, bytes) in (HEAD + 1..).zip(text.chunks(PIECE_BYTES)) {
            let mut piece = Piece([0; PIECE_BYTES]);
            piece.0[..bytes.len()].copy_from_slice(bytes);
            creator = creator.add(key, piece);
        }
        match creator.max_readers(64).max_nodes(64).create() {
            Ok(board) => {
                let writer = board.writer_builder().create().map_err(|e| failed(e.to_string()))?;
                return Ok(Published { _writer: writer, _board: board });
            }
            // Another engine has the name. Or a dead one had it, and someone is removing what it left or still reads it.
            Err(
                BlackboardCreateError::AlreadyExists
                | BlackboardCreateError::IsBeingCreatedByAnotherInstance
                | BlackboardCreateError::HangsInCreation
                | BlackboardCreateError::ServiceInCorruptedState,
            ) => refuse_second_engine(node, &specification.service)?,
            Err(e) => return Err(failed(e.to_string())),
        }
        node.clean();
        let waited = start.elapsed();
        if waited >= 3 * CLEANUP_TIMEOUT {
            return Err(ServiceError::EngineExists { service: specification.service.clone(), pid: None });
        }
        if waited >= CLEANUP_TIMEOUT {
            sweep::services(node.config());
        }
        if waited >= CLEANUP_TIMEOUT && !forced {
            forced = true;
            // SAFETY: for a second the name has had no living engine, and nobody managed to remove what a dead one left. Its
            // readers look at it for less than a millisecond.
            let removed = unsafe { node.force_remove_service(&name, MessagingPatternKind::Blackboard) };
            removed.map_err(|e| failed(e.to_string()))?;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Fails if an engine of that name runs.
pub(super) fn refuse_second_engine(node: &Member, service: &str) -> Result<(), ServiceError> {
    let name = Names::specification(service)?;
    let Ok(board) = node.service_builder(&name).blackboard_opener::<u32>().open() else { return Ok(()) };
    match writer(&board) {
        Some(owner) if node.is_alive(owner) => {
            let pid = node.process_of(owner);
            Err(ServiceError::EngineExists { service: service.to_owned(), pid })
        }
        _ => Ok(()),
    }
}

/// The engine's node.
fn writer(board: &blackboard::PortFactory<Ipc, u32>) -> Option<UniqueNodeId> {
    ports::first_node(|found| {
        board.dynamic_config().list_writers(|details| {
            found(details.node_id);
            CallbackProgression::Continue
        });
    })
}

/// Reads the specification of the engine of that name; `None` if there is none.
pub(super) fn read(node: &Member, service: &str) -> Result<Option<Specification>, ServiceError> {
    check_name(service)?;
    let failed = ServiceError::middleware("cannot read the specification");
    let unreadable = |reason: String| ServiceError::Specification { service: service.to_owned(), reason };
    let name = Names::specification(service)?;
    let board = match node.service_builder(&name).blackboard_opener::<u32>().open() {
        Ok(board) => board,
        // There is none, or one is starting, or a dead one's is being removed.
        Err(
            BlackboardOpenError::DoesNotExist
            | BlackboardOpenError::IsMarkedForDestruction
            | BlackboardOpenError::HangsInCreation
            | BlackboardOpenError::ServiceInCorruptedState,
        ) => return Ok(None),
        Err(BlackboardOpenError::VersionMismatch) => {
            let (layout, package) = ("unknown".to_owned(), "with another version of iceoryx2".to_owned());
            return Err(ServiceError::Version { service: service.to_owned(), layout, package });
        }
        Err(e) => return Err(failed(e.to_string())),
    };
    if !writer(&board).is_some_and(|writer| node.is_alive(writer)) {
        // What a dead engine left.
        return Ok(None);
    }
    let reader = board.reader_builder().create().map_err(|e| failed(e.to_string()))?;
    let head = *reader.entry::<Head>(&HEAD).map_err(|e| unreadable(e.to_string()))?.get();
    if head.layout_version != LAYOUT_VERSION {
        let package = String::from_utf8_lossy(&head.package).trim_end_matches('\0').to_owned();
        let layout = head.layout_version.to_string();
        return Err(ServiceError::Version { service: service.to_owned(), layout, package });
    }
    let mut text = Vec::new();
    for key in HEAD + 1..=head.length.div_ceil(PIECE_BYTES as u32) {
        let piece = reader.entry::<Piece>(&key).map_err(|e| unreadable(e.to_string()))?.get();
        text.extend_from_slice(&piece.0);
    }
    text.truncate(head.length as usize);
    serde_json::from_slice(&text).map(Some).map_err(|e| unreadable(e.to_string()))
}

/// Names of the engines in a namespace, in alphabetical order.
pub fn engines(namespace: &Namespace) -> Result<Vec<String>, ServiceError> {
    // Joining removes what dead engines left, which would be listed too.
    list(&Member::join(namespace)?)
}

pub(super) fn list(node: &Member) -> Result<Vec<String>, ServiceError> {
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
