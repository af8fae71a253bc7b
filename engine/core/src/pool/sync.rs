//! Synchronisation primitives for the threads of a step: the standard library's and crossbeam's, or loom's models of them under
//! `--cfg loom`.

use std::sync::PoisonError;

#[cfg(loom)]
pub(super) use loom::sync::{Mutex, MutexGuard};
#[cfg(not(loom))]
pub(super) use std::sync::{Mutex, MutexGuard};

/// Locks a mutex, even a poisoned one: no code under these locks can leave their data half written.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Other primitives for worker threads.
#[cfg(all(feature = "threads", not(loom)))]
pub(super) mod threads {
    pub(in crate::pool) use std::sync::Arc;
    pub(in crate::pool) use std::sync::atomic::{AtomicBool, AtomicPtr, AtomicU64, AtomicUsize, Ordering, fence};
    pub(in crate::pool) use std::thread;
    use std::time::{Duration, Instant};

    /// A worker that has not been called for this long parks. Most trainers call the next step sooner.
    pub(in crate::pool) const PARK_AFTER: Duration = Duration::from_millis(3);

    /// Polls between two looks at the clock.
    const POLLS: u32 = 32;

    /// Waits between polls: spins for a while, then yields.
    pub(in crate::pool) struct Wait {
        start: Instant,
        spin: Duration,
        waited: Duration,
        polls: u32,
    }

    impl Wait {
        /// Spins until `spin` has passed.
        pub(in crate::pool) fn new(spin: Duration) -> Self {
            Wait { start: Instant::now(), spin, waited: Duration::ZERO, polls: 0 }
        }

        /// Waits until the next poll.
        pub(in crate::pool) fn pause(&mut self) {
            self.polls = self.polls.wrapping_add(1);
            if self.waited >= self.spin {
                thread::yield_now();
            } else {
                std::hint::spin_loop();
                if !self.polls.is_multiple_of(POLLS) {
                    return;
                }
            }
            self.waited = self.start.elapsed();
        }

        /// The time since the start, a few polls ago.
        pub(in crate::pool) fn waited(&self) -> Duration {
            self.waited
        }
    }
}

/// The same primitives under loom. `--cfg crossbeam_loom` models `crossbeam_utils::sync::Parker` itself.
#[cfg(all(feature = "threads", loom))]
pub(super) mod threads {
    pub(in crate::pool) use loom::sync::Arc;
    pub(in crate::pool) use loom::sync::atomic::{AtomicBool, AtomicPtr, AtomicU64, AtomicUsize, Ordering, fence};
    pub(in crate::pool) use loom::thread;
    use std::time::Duration;

    /// Workers park at once: loom does not model time, and only a parked worker can miss a call.
    pub(in crate::pool) const PARK_AFTER: Duration = Duration::ZERO;

    /// Yields to another thread.
    pub(in crate::pool) struct Wait;

    impl Wait {
        pub(in crate::pool) fn new(_spin: Duration) -> Self {
            Wait
        }

        pub(in crate::pool) fn pause(&mut self) {
            thread::yield_now();
        }

        pub(in crate::pool) fn waited(&self) -> Duration {
            Duration::ZERO
        }
    }
}
