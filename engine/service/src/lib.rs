//! Environments in shared memory: an engine, its trainer and its observers.
//!
//! An **engine** serves groups of environments under a name. A **trainer** steps them, and **observers** receive the
//! same batches. They are processes of one user on one host and find each other in a [`Namespace`]. The transport is
//! iceoryx2: the sender writes a message once, into the memory where the receiver reads it.
//!
//! # Services
//!
//! An engine has iceoryx2 services for the requests (`act`) and the responses (`obs`) of each group, and for events;
//! `docs/design/protocol.md` in the repository lists them. The [`ServiceSpecification`] is JSON text in the engine's status file,
//! `/dev/shm/PREFIXNAME.INCARNATION.status` with the namespace's prefix. The engine holds an `flock` on this file until
//! it ends.
//!
//! # Messages
//!
//! The payload of `act` and `obs` is `[Block]`, laid out as the specification says. The user headers hold the other
//! fields:
//!
//! | header | fields |
//! | --- | --- |
//! | request | layout version, kind (step, reset all, reset with a seed, reset each, snapshot, restore, checkpoint, options of next episodes, running episodes), incarnation, trainer, request number, seed, environment, length of the options or of the snapshot, process id of the trainer, batches held |
//! | response | layout version, group, incarnation, step, trainer and number of the answered request, status, length of the snapshot, the text about episodes or the rejection |
//!
//! # Protocol
//!
//! | situation | behaviour |
//! | --- | --- |
//! | the engine receives a request | it sends exactly one response of the same group: a batch, a snapshot or a rejection; a rejected request changes no environment |
//! | the trainer requests a snapshot, a restore, or something about episodes | the response holds a snapshot, a text or nothing instead of a batch; observers skip it, and may miss the batch before it |
//! | several groups have requests | they are executed at the same time, if the engine has threads for them; each answer is sent when its group has finished |
//! | a group has a pending answer | the trainer must receive it before its next request to this group; other groups are independent |
//! | two engines are given the same checkpoint file | the second one fails with [`CheckpointError::InUse`], which names the first one's process |
//! | a new trainer connects | it must reset all environments of a group before it steps them, or adopt their episodes with a reset of no environment ([`ResetRequest::Each`](endless_gym_core::pool::ResetRequest::Each) with flags of 0), which returns the current batch |
//! | the engine has a checkpoint file | it saves all environments periodically, when it stops, and when the trainer requests it; a new engine that resumes from the file continues identically |
//! | a second trainer connects | it is refused, because `act` accepts one publisher |
//! | a trainer dies | its resources are removed by the engine when idle, or by the next trainer when it connects |
//! | an engine dies or ends | its trainer and its observers detect it with their liveness checks; a trainer may reconnect to a new engine |
//! | an observer waits for a batch | it sleeps on a futex in the engine's status file, which counts the batches; the engine wakes one observer, and each one wakes others, so that their number does not slow the engine; a dead one leaves nothing behind |
//! | an observer is slow | it misses batches: its queue holds one batch, which newer ones overwrite |
//! | an observer is paused | it has no port and receives nothing; its slot and its memory stay reserved |
//! | an observer resumes while the trainer pauses | the idle engine sends the last batch of the group again, with the same header; the trainer skips it, since it answers no pending request, and no observer returns a step twice |
//! | an observer holds batches | their memory in the engine's segment was reserved when it connected (otherwise it is refused); that of engine and trainer, when the engine started |
//! | a request names another incarnation | the engine ignores it |
//! | a process wants to see environments whose batches have no frames | it creates a file in shared memory, `/dev/shm/PREFIXINCARNATION.NUMBER.picture`, with their numbers ([`Pictures`]); the engine draws them into it at most ten times per second, until the process ends |
//! | a process asks what an engine is doing | it reads the engine's [`EngineStatus`] from a file in shared memory, which affects no other process |
//! | an engine dies and a new one takes its name | the old specification is removed under the namespace's lock, so that the new one's is never removed |
//!
//! # Faults outside the engine
//!
//! | situation | behaviour |
//! | --- | --- |
//! | `/dev/shm` is full, or the limit of file descriptors is too low | [`ServiceError::SharedMemoryTooSmall`] or [`ServiceError::DescriptorLimit`] before iceoryx2 creates anything; the soft limit of descriptors is raised if the hard limit permits it |
//! | the control group of the process (a container, a batch job) may have less memory than shared memory needs | [`ServiceError::MemoryLimit`] before iceoryx2 creates anything; SIGKILL by the system if the rest of the process uses up the limit |
//! | the address space or the size of files is limited (`ulimit -v`, `ulimit -f`) | [`ServiceError::ResourceLimit`], which names the limit; the program `endless` blocks `SIGXFSZ`, which would end a process without cleanup |
//! | another process uses up `/dev/shm` while a process connects or starts | SIGBUS may kill the connecting process, since iceoryx2 allocates no memory in advance; processes that are connected already have their memory |
//! | a process dies while it creates something | the next process that gets the locks removes it, however recent it is; nothing incomplete is removed while a living process creates something, even if that process is stopped |
//! | dead processes fill `/dev/shm`, or their directory was removed | the next process that joins a namespace of the same path removes what no process uses, which it knows from the locks of the prefixes |
//! | a process is stopped while it holds the namespace's lock | the others wait: a starting engine 30 s, a trainer or observer its timeout but at least 5 s, and up to six times as long while the lock changes hands; after a second they log the holder, and [`ServiceError::NamespaceLocked`] names it |
//! | two directories have the same path (containers that share `/dev/shm` but not `/tmp`) | they are two namespaces, whose segments have different random prefixes |
//! | the namespace's directory is removed or replaced | within a second [`EngineHandle::join`] returns [`ServiceError::RootRemoved`], and `endless serve` starts again in a new directory; trainers and observers get the same error and may reconnect; the episodes are lost |
//! | another user creates segments with the names of a namespace | a namespace without processes gets another prefix; otherwise the call fails with [`ServiceError::ForeignSegment`]; other users have access to no lasting segment |
//! | a process forks | only the process that connected counts as alive; a forked child neither keeps it alive nor releases what it holds |
//! | an engine's files are removed while it starts | it checks after publishing that it can be found, starts again up to twice, and then ends with [`ServiceError::EngineUnreachable`] |
//!
//! # How often a request is executed
//!
//! A request steps or resets a group, restores an environment, or takes a snapshot. The trainer numbers its requests,
//! the engine numbers the batches of a group ([`BatchLease::step`]), and its status says which request it last took,
//! answered and executed. An engine executes each request that it takes once and sends one response; requests are never
//! resent.
//!
//! `set_options` behaves like `restore` in the table, and `running_episodes` like `snapshot`.
//!
//! | call | failure | the request was executed | what to do |
//! | --- | --- | --- | --- |
//! | `send`, `reset` | any error | never | |
//! | `receive`, `snapshot`, `restore` | [`ServiceError::Rejected`] | never | |
//! | | [`ServiceError::TimedOut`], a signal, an exception in Python | once, as long as the engine lives | call again; the answer stays pending |
//! | | [`ServiceError::TooManyBatchesHeld`] | once | drop a lease, call again |
//! | | [`ServiceError::EngineLost`], [`ServiceError::EngineRestarted`] | see [`reconnect`](Trainer::reconnect) | reconnect |
//! | `snapshot`, `restore` | another request follows a [`ServiceError::TimedOut`] | once, before that request | |
//! | `reconnect` | the engine is the same | [`LastRequest::Pending`]: once | receive the pending answers, and go on |
//! | | the engine was restarted | [`LastRequest::Played`]: once; [`LastRequest::NotPlayed`]: never; [`LastRequest::Unknown`]: cannot be known | reset; or go on from the new engine's [`step`](GroupReconnection::step), if it resumed from a checkpoint |
//! | the trainer is dropped or dies | a request without an answer | once or never; the status's [`step`](GroupStatus::step) tells | the next trainer must reset or adopt the environments |
//!
//! The state of the environments ends with their engine. Whatever it executed after its last checkpoint is lost; the
//! step number at which a resumed engine continues tells what to repeat.

/// What the operating system says of processes and their limits.
mod os {
    pub(crate) mod process;
    pub(crate) mod resource_limits;
}

mod error;

/// What the processes of a namespace share: its directory, its locks, and the cleanup after dead processes.
mod namespace {
    pub(crate) mod cleanup;
    pub(crate) mod descriptors;
    pub(crate) mod directory;
    pub(crate) mod fork_guard;
    pub(crate) mod iceoryx_files;
    pub(crate) mod identity;
    pub(crate) mod lock;
    pub(crate) mod locked_file;
    pub(crate) mod members;
    pub(crate) mod memory;
    pub(crate) mod node;
    pub(crate) mod segments;
}

/// What an engine and its clients exchange.
mod protocol {
    pub(crate) mod discovery;
    pub(crate) mod limits;
    pub(crate) mod message;
    pub(crate) mod picture_file;
    pub(crate) mod ports;
    pub(crate) mod specification;
    pub(crate) mod status_file;
    pub(crate) mod wait;
}

mod engine {
    pub(crate) mod checkpoint;
    pub(crate) mod config;
    pub(crate) mod group;
    pub(crate) mod handle;
    pub(crate) mod pictures;
    pub(crate) mod serving;
    pub(crate) mod status_writer;
}

/// The trainer, the observers, and the readers of an engine's status.
mod client {
    pub(crate) mod connect;
    pub(crate) mod connection;
    pub(crate) mod lease;
    pub(crate) mod observer;
    pub(crate) mod pictures;
    pub(crate) mod requests;
    pub(crate) mod status;
    pub(crate) mod trainer;
    pub(crate) mod trainer_group;
}

pub use client::connect::{ConnectConfig, timeout_from_seconds};
pub use client::lease::BatchLease;
pub use client::observer::{Observed, Observer, Observers};
pub use client::pictures::{Drawn, Pictures};
pub use client::requests::{GroupReconnection, LastRequest, Reconnection};
pub use client::status::{EngineMonitor, EngineProcesses, EngineStatus, GroupStatus, ObserverStatus};
pub use client::trainer::Trainer;
pub use client::trainer_group::TrainerGroup;
pub use engine::config::{CheckpointConfig, EngineConfig};
pub use engine::handle::{EngineHandle, EngineStopper};
pub use engine::serving::Engine;
pub use engine::status_writer::EngineSummary;
pub use error::{CHECKPOINT_VERSION, CheckpointError, EngineActivity, ErrorKind, Rejection, ServiceError};
pub use namespace::directory::{Namespace, ROOT_VARIABLE};
pub use os::process::LockHolder;
pub use protocol::discovery::running_engines;
pub use protocol::limits::{MAX_BATCHES_HELD, MAX_GROUPS};
pub use protocol::specification::ServiceSpecification;
