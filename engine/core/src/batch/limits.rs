//! The size of a batch.

/// Maximum number of environments in a pool and in its batch.
pub const MAX_ENVS: usize = 1 << 20;
