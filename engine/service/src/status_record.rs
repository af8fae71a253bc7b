//! The records of an engine's status: plain numbers that the engine writes and any process may read.

use bytemuck::{Pod, Zeroable};
use endless_gym_core::batch::LAYOUT_VERSION;
use rustix::time::{ClockId, clock_gettime};

use crate::engine_config::MAX_GROUPS;
use crate::message::RequestKind;

/// First word of a status file.
pub(crate) const MAGIC: u64 = u64::from_le_bytes(*b"EGYMSTAT");

/// What concerns the whole engine. Times are in nanoseconds of CLOCK_MONOTONIC, 0 for none.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct EngineRecord {
    pub magic: u64,
    pub layout_version: u32,
    pub process: u32,
    pub incarnation: u64,
    pub started: u64,
    pub groups: u32,
    pub num_envs: u32,
    /// Requests for an earlier incarnation, which were ignored.
    pub dropped: u64,
    /// Dead processes whose resources the engine removed.
    pub recoveries: u64,
    /// Checkpoints saved, and when the last one was.
    pub checkpoints: u64,
    pub last_checkpoint: u64,
    /// Environment id and engine name, padded with zeros.
    pub id: [u8; 64],
    pub service: [u8; 64],
}

impl EngineRecord {
    /// Whether a reader of this version can use the record.
    pub(crate) fn is_valid(&self) -> bool {
        let groups = usize::try_from(self.groups).unwrap_or(usize::MAX);
        self.magic == MAGIC && self.layout_version == LAYOUT_VERSION && (1..=MAX_GROUPS).contains(&groups)
    }
}

/// What concerns one group. Times are as in [`EngineRecord`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct GroupRecord {
    /// Batches returned, as in the header of a response.
    pub step: u64,
    /// The trainer of the last request, and how many trainers there were.
    pub trainer: u64,
    pub trainers: u64,
    /// Numbers of that trainer's requests: the last one that was taken, answered, and executed rather than rejected.
    pub taken: u64,
    pub answered: u64,
    pub executed: u64,
    /// When the current request was taken; 0 if there is none.
    pub busy_since: u64,
    /// When the last request was taken.
    pub last_request: u64,
    pub batches: u64,
    pub env_steps: u64,
    pub episodes: u64,
    pub rejected: u64,
    pub undelivered: u64,
    /// Code of the last request's [`RequestKind`].
    pub kind: u32,
    /// Process id of the trainer, as it gave it.
    pub trainer_process: u32,
    /// Batches that the trainer held when it sent the last request.
    pub held: u32,
    pub padding: u32,
}

impl GroupRecord {
    /// The kind of the last request in a word.
    pub(crate) fn kind(&self) -> &'static str {
        RequestKind::from_code(self.kind).map_or("request", RequestKind::name)
    }
}

/// What concerns one observer. Times are as in [`EngineRecord`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct ObserverRecord {
    /// Process id, as the observer gives it.
    pub process: u32,
    pub group: u32,
    /// Batches received.
    pub batches: u64,
    /// When it received the last one.
    pub last_batch: u64,
    /// Batches that it held then, including that one.
    pub held: u32,
    pub padding: u32,
}

/// Nanoseconds of CLOCK_MONOTONIC, which is the same in all processes of a host; at least 1.
pub(crate) fn now() -> u64 {
    let time = clock_gettime(ClockId::Monotonic);
    let seconds = u64::try_from(time.tv_sec).unwrap_or(0);
    seconds.saturating_mul(1_000_000_000).saturating_add(u64::try_from(time.tv_nsec).unwrap_or(0)).max(1)
}

/// Text as a field that is padded with zeros.
pub(crate) fn padded<const N: usize>(text: &str) -> [u8; N] {
    let mut bytes = [0; N];
    bytes.iter_mut().zip(text.bytes()).for_each(|(to, from)| *to = from);
    bytes
}

/// The text of a field that is padded with zeros.
pub(crate) fn unpadded(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).trim_end_matches('\0').chars().filter(|c| !c.is_control()).collect()
}
