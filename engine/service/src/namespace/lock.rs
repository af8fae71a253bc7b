//! The lock of a namespace, which serialises everything that creates or removes a node, or takes an engine's name:
//!
//! - join the namespace: read or create its identity, and create a node;
//! - check that no engine of a name is running, and publish a new one's specification;
//! - leave the namespace;
//! - remove the resources of dead nodes and orphans, which is skipped if the lock is not free.
//!
//! It is an advisory `flock` on the namespace's directory: it leaves no file behind, and the kernel releases it when
//! its holder dies.
//!
//! It is held for milliseconds. A stopped holder (SIGSTOP, a debugger, a frozen container) may be in the middle of a
//! removal, so its lock is never broken: the others wait as long as their caller allows, continue within a millisecond
//! after its release, and name the holder in a warning after a second and in their error. If several processes hold it
//! in turn, as on a busy machine, the others wait longer: only a holder that keeps it is an error.

use std::fs::{self, File, TryLockError};
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::time::{Duration, Instant};

use crate::error::ServiceError;
use crate::os::process::{self, LockHolder};

/// Shortest wait for the lock before a process reports an error.
pub(crate) const LOCK_TIMEOUT: Duration = Duration::from_secs(5);

/// How long a process waits before it warns.
const WARNING_AFTER: Duration = Duration::from_secs(1);

const RETRY_INTERVAL: Duration = Duration::from_millis(1);

/// How often a waiter checks who holds the lock.
const HOLDER_INTERVAL: Duration = Duration::from_millis(250);

/// Longest total wait while the lock changes hands, in multiples of the timeout.
const LONGEST_WAIT: u32 = 6;

/// The lock while it is held. Every acquisition opens the directory again, so that the threads of a process exclude
/// each other, too. A thread must not acquire it twice.
pub(crate) struct NamespaceLock(File);

impl NamespaceLock {
    /// The lock of the namespace at `root` if it is free.
    pub(crate) fn try_acquire(root: &Path) -> Option<Self> {
        let directory = File::open(root).ok()?;
        directory.try_lock().ok()?;
        Some(NamespaceLock(directory))
    }

    /// Waits for the lock of the namespace at `root` up to [`LOCK_TIMEOUT`].
    #[cfg(test)]
    pub(crate) fn acquire(root: &Path) -> Result<Self, ServiceError> {
        Self::acquire_within(root, LOCK_TIMEOUT)
    }

    /// Waits for the lock of the namespace at `root` up to `timeout`.
    pub(crate) fn acquire_within(root: &Path, timeout: Duration) -> Result<Self, ServiceError> {
        let unusable = |e: std::io::Error| match e.kind() {
            ErrorKind::NotFound => ServiceError::RootRemoved { path: root.to_owned() },
            _ => ServiceError::Root { path: root.to_owned(), reason: e.to_string() },
        };
        let directory = File::open(root).map_err(unusable)?;
        let (start, mut warned) = (Instant::now(), false);
        let mut patience = Patience::new(timeout);
        loop {
            match directory.try_lock() {
                Ok(()) => break,
                Err(TryLockError::Error(e)) => return Err(unusable(e)),
                Err(TryLockError::WouldBlock) if patience.is_over(start.elapsed(), || holder(&directory)) => {
                    let holder = holder(&directory);
                    return Err(ServiceError::NamespaceLocked { path: root.to_owned(), waited: timeout, holder });
                }
                Err(TryLockError::WouldBlock) => {
                    if !warned && start.elapsed() >= WARNING_AFTER {
                        warned = true;
                        tracing::warn!(root = %root.display(), "waiting for {}", LockHolder::text(holder(&directory)));
                    }
                    std::thread::sleep(RETRY_INTERVAL);
                }
            }
        }
        // The directory may have been removed or replaced in the meantime.
        let (locked, named) = (directory.metadata().map_err(unusable)?, fs::metadata(root).map_err(unusable)?);
        if (locked.dev(), locked.ino()) == (named.dev(), named.ino()) {
            Ok(NamespaceLock(directory))
        } else {
            Err(ServiceError::RootRemoved { path: root.to_owned() })
        }
    }
}

impl Drop for NamespaceLock {
    fn drop(&mut self) {
        // Closing the file is not enough: a child process that was forked in the meantime shares the lock.
        let _ = self.0.unlock();
    }
}

/// Decides how long a process waits. Times are since it began to wait.
#[derive(Debug)]
struct Patience {
    timeout: Duration,
    /// The last holder that was seen.
    holder: Option<u32>,
    since: Duration,
    looked: Duration,
}

impl Patience {
    fn new(timeout: Duration) -> Self {
        Patience { timeout, holder: None, since: Duration::ZERO, looked: Duration::ZERO }
    }

    /// Whether one holder was seen to keep the lock for the whole timeout, or the wait has taken too long in total.
    fn is_over(&mut self, now: Duration, holder: impl FnOnce() -> Option<LockHolder>) -> bool {
        if now >= self.looked + HOLDER_INTERVAL {
            let pid = holder().map(|holder| holder.pid);
            if pid != self.holder {
                // The first holder seen may have had it from the beginning.
                self.since = if self.looked.is_zero() { Duration::ZERO } else { now };
                self.holder = pid;
            }
            self.looked = now;
        }
        now - self.since >= self.timeout || now >= self.timeout.saturating_mul(LONGEST_WAIT)
    }
}

/// The process that holds the lock on `directory`, from `/proc/locks`; `None` if it cannot be found, for example
/// because it died and left the lock to a child that it had forked.
fn holder(directory: &File) -> Option<LockHolder> {
    let data = directory.metadata().ok()?;
    let (major, minor) = (rustix::fs::major(data.dev()), rustix::fs::minor(data.dev()));
    let inode = format!("{major:02x}:{minor:02x}:{}", data.ino());
    let locks = fs::read_to_string("/proc/locks").ok()?;
    let pid = locks.lines().find_map(|line| {
        // `1: FLOCK ADVISORY WRITE 1234 fe:00:5678 0 EOF`; a waiter has `->` in the second place.
        let words: Vec<&str> = line.split_whitespace().collect();
        (words.get(1) == Some(&"FLOCK") && words.get(5) == Some(&&*inode)).then(|| words[4].parse().ok()).flatten()
    })?;
    Some(LockHolder { pid, stopped: matches!(process::state(pid)?, 'T' | 't') })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_holder_that_keeps_the_lock_exhausts_the_patience() {
        let first_error = |pid: fn(u64) -> u32| {
            let mut patience = Patience::new(LOCK_TIMEOUT);
            (0..100_000).find(|now| {
                let holder = || Some(LockHolder { pid: pid(*now), stopped: false });
                patience.is_over(Duration::from_millis(*now), holder)
            })
        };
        assert_eq!(first_error(|_| 7), Some(5000));
        assert_eq!(first_error(|now| if now < 3000 { 7 } else { 8 }), Some(8000));
        assert_eq!(first_error(|now| (now / 1000) as u32), Some(30_000));
        assert!(Patience::new(Duration::ZERO).is_over(Duration::ZERO, || None));
    }

    #[test]
    fn one_holder_excludes_all_others_and_is_named() {
        let root = std::env::temp_dir().join(format!("endless-lock-{}", std::process::id()));
        std::fs::create_dir_all(&root).unwrap();
        let lock = NamespaceLock::acquire(&root).unwrap();
        assert!(NamespaceLock::try_acquire(&root).is_none());
        let refused = NamespaceLock::acquire_within(&root, Duration::ZERO).map(drop).unwrap_err();
        let own = LockHolder { pid: std::process::id(), stopped: false };
        assert!(
            matches!(&refused, ServiceError::NamespaceLocked { holder: Some(holder), .. } if *holder == own),
            "{refused}"
        );
        drop(lock);
        assert!(NamespaceLock::try_acquire(&root).is_some());
        std::fs::remove_dir(&root).unwrap();
        assert!(matches!(NamespaceLock::acquire(&root), Err(ServiceError::RootRemoved { .. })));
    }
}
