//! What a trainer learns when it reconnects.

use crate::status_record::GroupRecord;

/// What [`Trainer::reconnect`](crate::Trainer::reconnect) found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reconnection {
    /// Whether the engine is another run than before. Otherwise the connection was kept.
    pub restarted: bool,
    /// Identifies the run of the engine that is connected now.
    pub incarnation: u64,
    /// By group.
    pub groups: Vec<GroupReconnection>,
}

/// What [`Trainer::reconnect`](crate::Trainer::reconnect) found out about a group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GroupReconnection {
    /// Batches that the group has returned in the engine that is connected now. An engine that resumed from a checkpoint counts on
    /// from there. `None` if its status cannot be read.
    pub step: Option<u64>,
    /// Batches that the group had returned in the engine that ended; `None` if the engine is the same, or if its status cannot be
    /// read.
    pub lost_step: Option<u64>,
    /// What became of the trainer's last request to the group.
    pub last_request: LastRequest,
}

/// What became of a trainer's last request to a group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LastRequest {
    /// There was none since the trainer connected to that run of the engine.
    None,
    /// The engine is running, and the answer has not been received. It can be received, and the request is executed once.
    Pending,
    /// It was executed once.
    Played,
    /// It was not executed: it was rejected, or the engine ended before it took the request.
    NotPlayed,
    /// The engine ended while it executed the request, or its status cannot be read.
    Unknown,
}

impl LastRequest {
    /// What became of the pending request `number` of `trainer`, by the last status of an engine that has ended.
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
