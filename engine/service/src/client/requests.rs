//! A trainer's pending requests, and what is known about its last ones.

use crate::protocol::message::RequestKind;
use crate::protocol::status_file::GroupRecord;

/// A request of a trainer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Request {
    pub kind: RequestKind,
    /// First seed of a [`RequestKind::ResetSeed`].
    pub seed: u64,
    /// Environment of a [`RequestKind::Snapshot`] or a [`RequestKind::Restore`].
    pub env: usize,
    /// Checksum of the payload of a [`RequestKind::Restore`], a [`RequestKind::SetOptions`] or a [`RequestKind::Episodes`].
    pub checksum: u32,
}

impl Request {
    pub(crate) fn new(kind: RequestKind) -> Self {
        Request { kind, seed: 0, env: 0, checksum: 0 }
    }
}

/// The pending request of a group, and what became of the last one.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PendingRequest {
    /// Its number and content.
    pub pending: Option<(u64, Request)>,
    pub last: LastRequest,
}

impl PendingRequest {
    pub(crate) const NONE: Self = PendingRequest { pending: None, last: LastRequest::None };

    /// Replaces the pending request.
    pub(crate) fn insert(&mut self, number: u64, request: Request) {
        *self = PendingRequest { pending: Some((number, request)), last: LastRequest::Pending };
    }

    /// The pending request was answered: it was executed, or rejected.
    pub(crate) fn answered(&mut self, executed: bool) {
        let last = if executed { LastRequest::Played } else { LastRequest::NotPlayed };
        *self = PendingRequest { pending: None, last };
    }

    /// Whether that request is pending.
    pub(crate) fn has(&self, request: Request) -> bool {
        self.pending.is_some_and(|(_, pending)| pending == request)
    }

    /// The number of the pending request, if it returns a batch (`batch`) or does not (`!batch`).
    pub(crate) fn number(&self, batch: bool) -> Option<u64> {
        self.pending.filter(|(_, pending)| pending.kind.returns_batch() == batch).map(|(number, _)| number)
    }

    /// Whether a request that returns a batch is pending.
    pub(crate) fn has_batch(&self) -> bool {
        self.number(true).is_some()
    }
}

/// What [`Trainer::reconnect`](crate::Trainer::reconnect) found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reconnection {
    /// Whether the engine was restarted. Otherwise the connection was kept.
    pub restarted: bool,
    /// Identifies the run of the engine that is connected now.
    pub incarnation: u64,
    /// By group.
    pub groups: Vec<GroupReconnection>,
}

/// What [`Trainer::reconnect`](crate::Trainer::reconnect) found out about a group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GroupReconnection {
    /// Batches that the group has returned in the current engine. An engine that resumed from a checkpoint continues
    /// its count. `None` if its status cannot be read.
    pub step: Option<u64>,
    /// Batches that the group had returned in the engine that ended; `None` if the engine is the same or its status
    /// cannot be read.
    pub lost_step: Option<u64>,
    /// What became of the trainer's last request to the group.
    pub last_request: LastRequest,
}

/// What became of a trainer's last request to a group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LastRequest {
    /// The trainer has sent none since it connected to that run of the engine.
    None,
    /// The engine is running, and the answer can still be received. The request is executed once.
    Pending,
    /// It was executed once.
    Played,
    /// It was not executed: it was rejected, or the engine ended before it took the request.
    NotPlayed,
    /// The engine ended while it executed the request, or its status cannot be read.
    Unknown,
}

impl LastRequest {
    /// What became of the pending request `number` of `trainer`, according to the last status of an engine that has
    /// ended.
    pub(crate) fn of_dead_engine(status: Option<GroupRecord>, trainer: u64, number: u64) -> Self {
        match status {
            None => LastRequest::Unknown,
            Some(status) if status.trainer != trainer || status.taken < number => LastRequest::NotPlayed,
            Some(status) if status.executed == number => LastRequest::Played,
            Some(status) if status.answered == number => LastRequest::NotPlayed,
            Some(_) => LastRequest::Unknown,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_status_tells_what_became_of_a_request() {
        let fate = |taken, answered, executed| {
            let status = GroupRecord { trainer: 3, taken, answered, executed, ..GroupRecord::default() };
            LastRequest::of_dead_engine(Some(status), 3, 7)
        };
        assert_eq!(fate(6, 6, 6), LastRequest::NotPlayed);
        assert_eq!(fate(7, 6, 6), LastRequest::Unknown);
        assert_eq!(fate(7, 7, 7), LastRequest::Played);
        assert_eq!(fate(7, 7, 6), LastRequest::NotPlayed);
        let other = GroupRecord { trainer: 4, taken: 7, answered: 7, executed: 7, ..GroupRecord::default() };
        assert_eq!(LastRequest::of_dead_engine(Some(other), 3, 7), LastRequest::NotPlayed);
        assert_eq!(LastRequest::of_dead_engine(None, 3, 7), LastRequest::Unknown);
    }
}
