//! The threads that step a pool's environments.

#[cfg(feature = "threads")]
#[allow(unsafe_code)] // The crate's only module with unsafe code: see its SAFETY comment.
mod workers;

use super::error::PoolError;
#[cfg(feature = "threads")]
use crate::batch::limits::MAX_THREADS;

/// Threads that step environments: the calling thread and workers. Several pools may share them; they then take turns.
///
/// Without the crate's feature `threads`, as on targets that have no threads, only the calling thread steps.
#[derive(Clone, Debug)]
pub struct Threads {
    #[cfg(feature = "threads")]
    workers: Option<std::sync::Arc<workers::Workers>>,
}

#[cfg(feature = "threads")]
impl Threads {
    /// `count` threads, including the calling one, at most [`MAX_THREADS`]; 0 means one for each core.
    ///
    /// # Errors
    ///
    /// If there are too many, or if the operating system cannot start them.
    pub fn new(count: usize) -> Result<Self, PoolError> {
        if count > MAX_THREADS {
            return Err(PoolError::ThreadCount { given: count });
        }
        let count = if count == 0 {
            std::thread::available_parallelism().map_or(1, usize::from).min(MAX_THREADS)
        } else {
            count
        };
        let workers = (count > 1).then(|| workers::Workers::new(count - 1)).transpose();
        let workers = workers.map_err(|source| PoolError::Threads { count, source })?;
        Ok(Threads { workers: workers.map(std::sync::Arc::new) })
    }

    /// Number of threads that step environments at the same time, including the calling one.
    pub fn count(&self) -> usize {
        1 + self.workers.as_ref().map_or(0, |workers| workers.count())
    }

    /// Calls `work(0)` in this thread and, at the same time, `work(n)` for each `n` of `1..=helpers` whose worker joins before
    /// the calling thread is done. Returns when all calls have returned; a panic in any of them resumes here.
    pub(super) fn run(&self, helpers: usize, work: &(dyn Fn(usize) + Sync)) {
        match &self.workers {
            Some(workers) if helpers > 0 => workers.run(helpers, work),
            _ => work(0),
        }
    }
}

#[cfg(not(feature = "threads"))]
impl Threads {
    /// The calling thread. `count` must be 0 or 1.
    ///
    /// # Errors
    ///
    /// If `count` is greater than 1.
    pub fn new(count: usize) -> Result<Self, PoolError> {
        if count > 1 {
            let source = std::io::Error::new(std::io::ErrorKind::Unsupported, "this build has no threads");
            return Err(PoolError::Threads { count, source });
        }
        Ok(Threads {})
    }

    /// Number of threads that step environments at the same time: 1.
    pub fn count(&self) -> usize {
        1
    }

    /// Calls `work(0)`.
    pub(super) fn run(&self, _helpers: usize, work: &(dyn Fn(usize) + Sync)) {
        work(0);
    }
}
