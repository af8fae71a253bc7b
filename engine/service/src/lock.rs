//! The lock of a namespace, which serialises everything that creates or removes a specification service.
//!
//! iceoryx2 removes a service by its name. A process that has decided to remove the service of a dead engine could therefore
//! remove that of a successor which has taken the name in the meantime. The lock covers decision and removal:
//!
//! - publish a specification, and remove what a dead engine left under its name;
//! - close the specification service of an engine that ends;
//! - remove the resources of dead nodes and orphans, which is skipped if the lock is not free;
//! - read a specification, because the last process that closes a service removes it.
//!
//! Readers exclude each other too: with a shared lock, many waiting trainers could starve an engine that starts. The lock is an
//! advisory `flock` on the namespace's directory: it leaves no file behind, and the kernel releases it when its holder dies.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::time::{Duration, Instant};

use crate::error::ServiceError;

/// How long a process waits for the lock before it reports an error. The longest regular holder waits half a second for a service
/// whose creation was interrupted.
const LOCK_TIMEOUT: Duration = Duration::from_secs(5);

const RETRY_INTERVAL: Duration = Duration::from_millis(1);

/// The lock while it is held. Every acquisition opens the directory anew, so that threads of one process exclude each other too.
/// A thread must not acquire it twice.
pub(crate) struct NamespaceLock(File);

impl NamespaceLock {
    /// The lock of the namespace at `root` if it is free.
    pub(crate) fn try_acquire(root: &Path) -> Option<Self> {
        let directory = File::open(root).ok()?;
        directory.try_lock().ok()?;
        Some(NamespaceLock(directory))
    }

    /// Waits for the lock of the namespace at `root`.
    pub(crate) fn acquire(root: &Path) -> Result<Self, ServiceError> {
        Self::acquire_within(root, LOCK_TIMEOUT)
    }

    /// Waits for the lock of the namespace at `root` up to `timeout`.
    pub(crate) fn acquire_within(root: &Path, timeout: Duration) -> Result<Self, ServiceError> {
        let unusable = |e: std::io::Error| ServiceError::Root { path: root.to_owned(), reason: e.to_string() };
        let directory = File::open(root).map_err(unusable)?;
        let start = Instant::now();
        loop {
            match directory.try_lock() {
                Ok(()) => return Ok(NamespaceLock(directory)),
                Err(TryLockError::Error(e)) => return Err(unusable(e)),
                Err(TryLockError::WouldBlock) if start.elapsed() >= timeout => {
                    return Err(ServiceError::NamespaceLocked { path: root.to_owned(), waited: timeout });
                }
                Err(TryLockError::WouldBlock) => std::thread::sleep(RETRY_INTERVAL),
            }
        }
    }
}

impl Drop for NamespaceLock {
    fn drop(&mut self) {
        // Closing the file is not enough: a child process that was forked in the meantime shares the lock.
        let _ = self.0.unlock();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_holder_excludes_all_others() {
        let root = std::env::temp_dir().join(format!("endless-lock-{}", std::process::id()));
        std::fs::create_dir_all(&root).unwrap();
        let lock = NamespaceLock::acquire(&root).unwrap();
        assert!(NamespaceLock::try_acquire(&root).is_none());
        drop(lock);
        assert!(NamespaceLock::try_acquire(&root).is_some());
        std::fs::remove_dir(&root).unwrap();
        assert!(matches!(NamespaceLock::acquire(&root), Err(ServiceError::Root { .. })));
    }
}
