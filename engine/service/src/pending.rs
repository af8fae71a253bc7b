//! The requests of a trainer that have not been answered yet, and what is known of the last ones.

use crate::message::RequestKind;
use crate::reconnection::LastRequest;

/// What is requested.
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

/// By group, the request that has not been answered yet, and the last request.
#[derive(Clone, Debug)]
pub(crate) struct PendingRequests(Vec<GroupRequests>);

#[derive(Clone, Copy, Debug)]
struct GroupRequests {
    /// Number and content of the request that has not been answered yet.
    pending: Option<(u64, Request)>,
    last: LastRequest,
}

impl PendingRequests {
    pub(crate) fn new(groups: usize) -> Self {
        PendingRequests(vec![GroupRequests { pending: None, last: LastRequest::None }; groups])
    }

    /// Number of groups.
    pub(crate) fn groups(&self) -> usize {
        self.0.len()
    }

    /// Replaces the pending request of a group.
    pub(crate) fn insert(&mut self, group: usize, number: u64, request: Request) {
        self.0[group] = GroupRequests { pending: Some((number, request)), last: LastRequest::Pending };
    }

    /// The pending request of a group was answered: it was executed, or rejected.
    pub(crate) fn answered(&mut self, group: usize, executed: bool) {
        let last = if executed { LastRequest::Played } else { LastRequest::NotPlayed };
        self.0[group] = GroupRequests { pending: None, last };
    }

    /// Whether that request is pending in a group.
    pub(crate) fn has(&self, group: usize, request: Request) -> bool {
        self.0[group].pending.is_some_and(|(_, pending)| pending == request)
    }

    /// The number of the request that is pending in a group.
    pub(crate) fn any_number(&self, group: usize) -> Option<u64> {
        self.0[group].pending.map(|(number, _)| number)
    }

    /// The number of the request that is pending in a group, if it returns a batch (`batch`) or does not (`!batch`).
    pub(crate) fn number(&self, group: usize, batch: bool) -> Option<u64> {
        self.0[group].pending.filter(|(_, pending)| pending.kind.returns_batch() == batch).map(|(number, _)| number)
    }

    /// What became of the last request to a group.
    pub(crate) fn last(&self, group: usize) -> LastRequest {
        self.0[group].last
    }

    /// Whether a group has a pending request that returns a batch.
    pub(crate) fn has_batch(&self, group: usize) -> bool {
        self.number(group, true).is_some()
    }

    /// Whether any group has a pending request that returns a batch.
    pub(crate) fn has_any_batch(&self) -> bool {
        (0..self.groups()).any(|group| self.has_batch(group))
    }
}
