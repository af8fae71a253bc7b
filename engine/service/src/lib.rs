//! Memory Gym environments in shared memory: an engine, its trainer and its observers.
//!
//! An **engine** serves groups of environments under a name. A **trainer** steps them, and **observers** receive the same
//! batches. They are processes of one user on one host and find each other in a [`Namespace`]. The transport is iceoryx2: a
//! message is written once, into the memory where its receiver reads it.
//!
//! # Services
//!
//! | iceoryx2 service | messaging pattern | direction | content |
//! | --- | --- | --- | --- |
//! | `endless-gym/NAME/INCARNATION/act/GROUP` | publish/subscribe | trainer → engine | requests |
//! | `endless-gym/NAME/INCARNATION/obs/GROUP` | publish/subscribe | engine → trainer, observers | responses |
//! | `endless-gym/NAME/INCARNATION/to_engine` | event | trainer → engine | number of a group with a request |
//! | `endless-gym/NAME/INCARNATION/to_trainer` | event | engine → trainer | number of a group with a response |
//!
//! The incarnation is a random number that an engine draws when it starts, so that an engine shares no service with a dead
//! predecessor of the same name. The [`ServiceSpecification`] is JSON text in the engine's status file in
//! `/dev/shm`, `NAME.INCARNATION.status` behind the namespace's prefix, which the engine locks (`flock`) for its life.
//!
//! # Messages
//!
//! The payload of `act` and `obs` is `[Block]`, in the layouts of the specification. The user headers hold the remaining fields:
//!
//! | header | fields |
//! | --- | --- |
//! | request | layout version, kind (step, reset all, reset with a seed, reset each, snapshot, restore, checkpoint, options of next episodes, running episodes), incarnation, trainer, request number, seed, environment, length of the options or of the snapshot, process id of the trainer, batches held |
//! | response | layout version, group, incarnation, step, trainer and number of the answered request, status, length of a snapshot, of a text about episodes or of a rejection |
//!
//! # Protocol
//!
//! | situation | behaviour |
//! | --- | --- |
//! | the engine receives a request | it sends exactly one response of the same group: a batch, a snapshot or a rejection; a rejected request changes no environment |
//! | the trainer requests a snapshot, a restore, or something about episodes | the response holds a snapshot, a text or nothing in place of a batch; observers skip it, and may miss the batch before it |
//! | a group has a pending answer | the trainer must receive it before its next request to this group; other groups are independent |
//! | two engines are given one checkpoint file | the second one ends with [`CheckpointError::InUse`], which names the first one's process |
//! | a new trainer connects | it must reset all environments of a group before it steps them, or adopt their episodes by a reset of none ([`ResetRequest::Each`](endless_gym_core::pool::ResetRequest::Each) with flags of 0), which returns the current batch |
//! | the engine has a checkpoint file | it saves all environments periodically, when it stops, and when the trainer asks for it; a new engine continues from there identically |
//! | a second trainer connects | it is refused, because `act` accepts one publisher |
//! | a trainer dies | the engine removes its resources when idle, or the next trainer does when it connects |
//! | an engine dies or ends | the liveness check of its trainer and its observers reports it; a trainer may reconnect to a new engine |
//! | an observer is slow | it misses batches: its queue has one place, which is overwritten |
//! | an observer is paused | it has no port and receives nothing; its place and its memory remain its own |
//! | an observer resumes while the trainer pauses | the idle engine sends the last batch of the group again, with the same header; the trainer skips it, since it answers no pending request, and an observer does not return a step twice |
//! | an observer holds batches | it has reserved their memory in the engine's segment when it connected, or was refused; engine and trainer have reserved theirs when the engine started |
//! | a request names another incarnation | the engine ignores it |
//! | any process wants to know what an engine is doing | it reads the engine's [`EngineStatus`] from a file in shared memory, which affects no other process |
//! | an engine dies and its name is taken again | its specification is removed under the lock of the namespace, so that a successor's is never removed |
//!
//! # Faults of the surroundings
//!
//! | situation | behaviour |
//! | --- | --- |
//! | `/dev/shm` is full, or too few file descriptors may be opened | [`ServiceError::SharedMemoryTooSmall`] or [`ServiceError::DescriptorLimit`] before iceoryx2 creates anything; the soft limit of descriptors is raised if the hard limit permits it |
//! | another process takes the last of `/dev/shm` while a process connects or starts | SIGBUS may end it, since iceoryx2 allocates no memory in advance; what is connected has its memory |
//! | a process dies while it creates something | the next process that has the locks removes it, whatever its age; while another process creates something, or is stopped at it, nothing incomplete is removed |
//! | dead processes fill `/dev/shm`, or their directory was removed | the next process that joins a namespace of the same path removes what no process uses, by the locks of the prefixes |
//! | a process is stopped while it holds the namespace's lock | the others wait: an engine 30 s to start, a trainer or observer as long as its timeout and at least 5 s, and up to six times that while one process takes it after another; after a second they log who holds it, and [`ServiceError::NamespaceLocked`] names it |
//! | two directories have the same path (containers that share `/dev/shm` and not `/tmp`) | they are two namespaces, whose segments have different random prefixes |
//! | the namespace's directory is removed or replaced | within a second [`Engine::run`] ends with [`ServiceError::RootRemoved`], and `endless serve` starts again in a new directory; trainers and observers get the same error and may reconnect; the episodes are lost |
//! | another user creates segments with the names of a namespace | a namespace without processes gets another prefix, otherwise [`ServiceError::ForeignSegment`]; no segment that stays is accessible to other users |
//! | a process forks | liveness is that of the process that connected; a child that it forked neither keeps it alive nor releases what it holds |
//! | an engine's files are removed while it starts | it checks after publishing that it can be found, starts again up to twice, and then ends with [`ServiceError::EngineUnreachable`] |
//!
//! # How often a request is executed
//!
//! A request steps or resets a group, restores an environment, or takes a snapshot. The trainer numbers its requests, the engine
//! numbers the batches of a group ([`BatchLease::step`]), and its status says which request it has taken, answered and executed.
//! An engine executes each request that it takes once and sends one response; no message is repeated.
//!
//! For `set_options` and `running_episodes` the table says what it says for `restore` and `snapshot`.
//!
//! | call | failure | the request was executed | what to do |
//! | --- | --- | --- | --- |
//! | `send`, `reset` | any error | never | |
//! | `receive`, `snapshot`, `restore` | [`ServiceError::Rejected`] | never | |
//! | | [`ServiceError::TimedOut`], a signal, an exception in Python | once, as long as the engine lives | call again; the answer stays pending |
//! | | [`ServiceError::TooManyBatchesHeld`] | once | drop a lease, call again |
//! | | [`ServiceError::EngineLost`], [`ServiceError::EngineRestarted`] | as [`reconnect`](Trainer::reconnect) says | reconnect |
//! | `snapshot`, `restore` | another request follows a [`ServiceError::TimedOut`] | once, before that request | |
//! | `reconnect` | the engine is the same | [`LastRequest::Pending`]: once | receive the pending answers, and go on |
//! | | the engine is another run | [`LastRequest::Played`]: once; [`LastRequest::NotPlayed`]: never; [`LastRequest::Unknown`]: cannot be known | reset; or go on from the new engine's [`step`](GroupReconnection::step), if it resumed from a checkpoint |
//! | drop of the trainer, its death | a request without an answer | once or never; the status's [`step`](GroupStatus::step) tells | the next trainer must reset or adopt the environments |
//!
//! The state of the environments ends with their engine. Whatever a dead engine executed after its last checkpoint is lost; the
//! step number in which a resumed engine goes on says what to repeat.

mod error;

/// What processes of one namespace share: its directory, its locks, and the removal of what dead processes left.
mod namespace {
    pub(crate) mod cleanup;
    pub(crate) mod descriptors;
    pub(crate) mod directory;
    pub(crate) mod fork_guard;
    pub(crate) mod identity;
    pub(crate) mod lock;
    pub(crate) mod locked_file;
    pub(crate) mod members;
    pub(crate) mod memory;
    pub(crate) mod node;
    pub(crate) mod process;
    pub(crate) mod segments;
}

/// What an engine and its clients exchange.
mod protocol {
    pub(crate) mod discovery;
    pub(crate) mod limits;
    pub(crate) mod message;
    pub(crate) mod ports;
    pub(crate) mod specification;
    pub(crate) mod status_file;
    pub(crate) mod wait;
}

/// The engine.
mod engine {
    pub(crate) mod checkpoint;
    pub(crate) mod config;
    pub(crate) mod group;
    pub(crate) mod serving;
    pub(crate) mod status_writer;
}

/// The trainer, the observers, and the readers of an engine's status.
mod client {
    pub(crate) mod connect;
    pub(crate) mod connection;
    pub(crate) mod lease;
    pub(crate) mod observer;
    pub(crate) mod requests;
    pub(crate) mod status;
    pub(crate) mod trainer;
}

pub use client::connect::{ConnectConfig, timeout_from_seconds};
pub use client::lease::BatchLease;
pub use client::observer::{Observed, Observer, Observers};
pub use client::requests::{GroupReconnection, LastRequest, Reconnection};
pub use client::status::{EngineProcesses, EngineStatus, GroupStatus, ObserverStatus};
pub use client::trainer::Trainer;
pub use engine::config::{CheckpointConfig, EngineConfig};
pub use engine::serving::Engine;
pub use engine::status_writer::EngineSummary;
pub use error::{CHECKPOINT_VERSION, CheckpointError, EngineActivity, Rejection, ServiceError};
pub use namespace::directory::{Namespace, ROOT_VARIABLE};
pub use namespace::process::LockHolder;
pub use protocol::discovery::running_engines;
pub use protocol::limits::{MAX_BATCHES_HELD, MAX_GROUPS};
pub use protocol::specification::ServiceSpecification;
