//! Limits of an engine.

/// Maximum number of groups of an engine.
pub const MAX_GROUPS: usize = 64;

/// Maximum number of batches of a group that a trainer or an observer may hold.
pub const MAX_BATCHES_HELD: usize = 16;

/// Maximum number of observers of a group.
pub(crate) const MAX_OBSERVERS: usize = 16;
