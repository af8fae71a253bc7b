//! The threads that step a pool's environments.

#[cfg(feature = "threads")]
mod pinning;
#[cfg(feature = "threads")]
mod shares;
mod step_times;
#[cfg(feature = "threads")]
mod times;
#[cfg(feature = "threads")]
#[allow(unsafe_code)] // The task that workers borrow during a call.
mod workers;

use std::ops::Range;

use super::error::PoolError;
#[cfg(feature = "threads")]
use super::sync::{Mutex, lock};
#[cfg(feature = "threads")]
use crate::batch::limits::MAX_THREADS;
pub use step_times::StepTimes;

/// Minimum number of environments per thread.
const ENVS_FOR_THREAD: usize = 16;

/// Minimum number of environments for using workers. The calling thread finishes fewer before a worker joins.
const ENVS_FOR_THREADS: usize = 64;

/// Maximum number of threads that step that many environments at the same time.
pub(super) fn useful_threads(num_envs: usize) -> usize {
    if num_envs < ENVS_FOR_THREADS { 1 } else { num_envs / ENVS_FOR_THREAD }
}

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
        let count = Self::resolve(count)?;
        Self::start(count, count, false)
    }

    /// Like [`new`](Self::new), for threads that [measure](Self::take_times) where the time of a step goes.
    ///
    /// # Errors
    ///
    /// Those of [`new`](Self::new).
    pub fn timed(count: usize) -> Result<Self, PoolError> {
        let count = Self::resolve(count)?;
        Self::start(count, count, true)
    }

    /// Starts `count` of `total` threads.
    fn start(count: usize, total: usize, timed: bool) -> Result<Self, PoolError> {
        let may_spin = total <= std::thread::available_parallelism().map_or(1, usize::from);
        let workers = (count > 1).then(|| workers::Workers::new(count - 1, may_spin, timed)).transpose();
        let workers = workers.map_err(|source| PoolError::Threads { count, source })?;
        Ok(Threads { workers: workers.map(std::sync::Arc::new) })
    }

    /// The sum over all steps on several threads since the last call of this function; `None` for threads that are not
    /// [`timed`](Self::timed).
    pub fn take_times(&self) -> Option<StepTimes> {
        self.workers.as_ref()?.take_times()
    }

    /// The number of threads for a given `count`.
    fn resolve(count: usize) -> Result<usize, PoolError> {
        match count {
            0 => Ok(std::thread::available_parallelism().map_or(1, usize::from).min(MAX_THREADS)),
            1..=MAX_THREADS => Ok(count),
            _ => Err(PoolError::ThreadCount { given: count }),
        }
    }

    /// `count` threads as in [`new`](Threads::new), divided among callers that step pools of `num_envs` environments at the same
    /// time: as many callers as get all threads that such a pool can use, at least 1 and at most `callers`, and no more threads than
    /// that. Each caller is one of its threads.
    ///
    /// # Errors
    ///
    /// Those of [`new`](Threads::new).
    ///
    /// ```
    /// use endless_gym_core::pool::Threads;
    ///
    /// let counts = |num_envs, callers| -> Result<Vec<_>, endless_gym_core::pool::PoolError> {
    ///     Ok(Threads::divided(8, num_envs, callers)?.iter().map(Threads::count).collect())
    /// };
    /// assert_eq!(counts(32, 3)?, [1, 1, 1]);
    /// assert_eq!(counts(64, 3)?, [4, 4]);
    /// assert_eq!(counts(1024, 3)?, [8]);
    /// # Ok::<(), endless_gym_core::pool::PoolError>(())
    /// ```
    pub fn divided(count: usize, num_envs: usize, callers: usize) -> Result<Vec<Self>, PoolError> {
        let count = Self::resolve(count)?;
        let callers = (count / useful_threads(num_envs)).clamp(1, callers.max(1));
        let of = |caller: usize| ((count + caller) / callers).min(useful_threads(num_envs));
        (0..callers).map(|caller| Self::start(of(caller), count, false)).collect()
    }

    /// Binds each worker to one CPU: worker `n` to number `first + n` of the calling thread's affinity mask, in increasing order.
    /// The calling thread is not bound; number `first` is left to it. To be called before
    /// [`pin_caller`](Self::pin_caller). For pools that step at the same time, let `first` be the number of threads before these.
    ///
    /// # Errors
    ///
    /// [`PoolError::PinnedThreads`] if the mask has fewer than `first + count` CPUs, and [`PoolError::Pin`] if the operating system
    /// refuses, or is not Linux.
    ///
    /// ```no_run
    /// let threads = endless_gym_core::pool::Threads::new(4)?;
    /// threads.pin(0)?;
    /// # Ok::<(), endless_gym_core::pool::PoolError>(())
    /// ```
    pub fn pin(&self, first: usize) -> Result<(), PoolError> {
        let cpus = pinning::cpus(first.saturating_add(self.count()))?;
        let (caller, failed) = (std::thread::current().id(), Mutex::new(None));
        self.on_each(self.count(), &|thread| {
            // In the child of a fork there are no workers, and the caller is called for them.
            let is_caller = std::thread::current().id() == caller;
            if let Err(error) = if is_caller { Ok(()) } else { pinning::pin(cpus[first + thread]) } {
                *lock(&failed) = Some(error);
            }
        });
        lock(&failed).take().map_or(Ok(()), Err)
    }

    /// Binds the calling thread to one CPU: number `number` of its affinity mask. Threads that it starts inherit that.
    ///
    /// # Errors
    ///
    /// Those of [`pin`](Self::pin).
    pub fn pin_caller(number: usize) -> Result<(), PoolError> {
        pinning::pin(pinning::cpus(number.saturating_add(1))?[number])
    }

    /// Number of threads that step environments at the same time, including the calling one.
    pub fn count(&self) -> usize {
        1 + self.workers.as_ref().map_or(0, |workers| workers.count())
    }

    /// Calls `work(n)` in the first `count` threads, where `n` is the thread's number, and returns when all have returned. Unlike a
    /// step, it waits for workers that sleep. For memory that each thread should be the first to write to, so that it lies near the
    /// thread's core.
    pub fn on_each(&self, count: usize, work: &(dyn Fn(usize) + Sync)) {
        match &self.workers {
            Some(workers) if count > 1 => workers.on_each(count.min(self.count()), work),
            _ => work(0),
        }
    }

    /// Calls `work` with ranges of `0..items`, in this thread and at the same time in those of `count - 1` workers that join before
    /// all is done. Each item is in one range. Returns when all calls have returned; a panic in any of them resumes here.
    pub(super) fn for_each_piece(&self, items: usize, count: usize, work: &(dyn Fn(Range<usize>) + Sync)) {
        match &self.workers {
            Some(workers) if count > 1 => workers.for_each_piece(items, count, work),
            _ => work(0..items),
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

    /// Calls `work(0..items)`.
    pub(super) fn for_each_piece(&self, items: usize, _count: usize, work: &(dyn Fn(Range<usize>) + Sync)) {
        work(0..items);
    }
}
