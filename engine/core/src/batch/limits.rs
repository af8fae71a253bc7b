//! Limits of a batch, and of the pool that writes it.

/// Maximum number of threads that step a pool's environments.
pub const MAX_THREADS: usize = 1024;

/// Maximum number of environments in a pool and in its batch.
pub const MAX_ENVS: usize = 1 << 20;
