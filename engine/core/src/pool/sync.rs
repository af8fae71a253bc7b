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

    pub(in crate::pool) use crossbeam_utils::Backoff;

    /// A worker that has not been called for this long parks. Most trainers call the next step sooner.
    pub(in crate::pool) const PARK_AFTER: std::time::Duration = std::time::Duration::from_millis(3);
}

/// The same primitives under loom. `--cfg crossbeam_loom` models `crossbeam_utils::sync::Parker` itself.
#[cfg(all(feature = "threads", loom))]
pub(super) mod threads {
    pub(in crate::pool) use loom::sync::Arc;
    pub(in crate::pool) use loom::sync::atomic::{AtomicBool, AtomicPtr, AtomicU64, AtomicUsize, Ordering, fence};
    pub(in crate::pool) use loom::thread;

    /// Workers park at once: loom does not model time, and only a parked worker can miss a call.
    pub(in crate::pool) const PARK_AFTER: std::time::Duration = std::time::Duration::ZERO;

    /// Yields to another thread. crossbeam's `Backoff` yields to the operating system, which loom does not see.
    pub(in crate::pool) struct Backoff;

    impl Backoff {
        pub(in crate::pool) fn new() -> Self {
            Backoff
        }

        pub(in crate::pool) fn snooze(&self) {
            thread::yield_now();
        }
    }
}
