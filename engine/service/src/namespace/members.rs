//! The processes that use a prefix of segments: each holds a shared lock on a file of that prefix in `/dev/shm`.
//!
//! The namespace's directory lists its processes, but it may have been removed or be in another container. A process
//! that gets the exclusive lock of a prefix knows that no other process uses the prefix any more, and may remove its
//! segments.

use std::fs::{self, File};
use std::io::Write;
use std::path::PathBuf;

use crate::error::ServiceError;
use crate::namespace::directory::{MAX_PREFIX, Namespace};
use crate::namespace::lock::NamespaceLock;
use crate::namespace::locked_file::{is_same, open};
use crate::namespace::segments;

/// What follows the prefix in the name of the file.
const SUFFIX: &str = ".members";

/// Marks this process as a user of a prefix. Forked children share it.
#[derive(Debug)]
pub(crate) struct Membership(#[expect(dead_code, reason = "held until it is dropped")] File);

impl Membership {
    /// Joins the users of the prefix. The namespace's lock keeps others from taking the new file for an unsized
    /// segment.
    pub(crate) fn join(prefix: &str, _lock: &NamespaceLock) -> Result<Self, ServiceError> {
        let path = file_of(prefix);
        let failed = ServiceError::file("cannot register this process", &path);
        loop {
            let mut file = open(&path, true).map_err(&failed)?;
            file.lock_shared().map_err(&failed)?;
            if file.metadata().map_err(&failed)?.len() == 0 {
                // An empty file would be removed as an unsized segment.
                file.write_all(b"\n").map_err(&failed)?;
            }
            // If they differ, another process has removed the file in the meantime.
            if is_same(&file, &path) {
                return Ok(Membership(file));
            }
        }
    }
}

/// Removes the segments of all unused prefixes of a namespace's path, except for the prefix `own`.
pub(crate) fn remove_abandoned(namespace: &Namespace, own: Option<&str>) {
    for path in segments::named(namespace.prefix(), SUFFIX) {
        let name = path.file_name().and_then(|name| name.to_str()?.strip_suffix(SUFFIX));
        let abandoned = name.filter(|prefix| prefix.len() == MAX_PREFIX && Some(*prefix) != own);
        abandoned.map(remove_if_unused);
    }
}

/// Removes the segments of a prefix if no process uses it. Returns whether it did.
pub(crate) fn remove_if_unused(prefix: &str) -> bool {
    let path = file_of(prefix);
    let Ok(file) = open(&path, false) else { return false };
    if file.try_lock().is_err() || !is_same(&file, &path) {
        return false;
    }
    for segment in segments::named(prefix, "").into_iter().filter(|segment| *segment != path) {
        tracing::debug!(path = %segment.display(), "removing a segment that no process uses");
        let _ = fs::remove_file(segment);
    }
    // Last: as long as this file exists, another process can finish an interrupted removal.
    fs::remove_file(path).is_ok()
}

/// Whether a process uses the prefix.
pub(crate) fn is_used(prefix: &str) -> bool {
    open(&file_of(prefix), false).is_ok_and(|file| file.try_lock().is_err())
}

fn file_of(prefix: &str) -> PathBuf {
    segments::path(&format!("{prefix}{SUFFIX}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_are_removed_when_the_last_process_has_left() {
        let root = std::env::temp_dir().join(format!("endless-members-{}", std::process::id()));
        fs::create_dir_all(&root).unwrap();
        let namespace = Namespace::at(&root);
        let lock = NamespaceLock::acquire(&root).unwrap();
        let prefix = |last: char| {
            format!("{}{}", namespace.prefix(), last.to_string().repeat(MAX_PREFIX - namespace.prefix().len()))
        };
        let (own, other) = (prefix('a'), prefix('b'));
        let segment = segments::path(&format!("{other}.data"));
        fs::write(&segment, "x").unwrap();

        let membership = Membership::join(&own, &lock).unwrap();
        let [first, second] = [(); 2].map(|()| Membership::join(&other, &lock).unwrap());
        drop(first);
        remove_abandoned(&namespace, Some(&own));
        assert!(segment.exists(), "a process uses it");
        drop(second);
        remove_abandoned(&namespace, Some(&other));
        assert!(segment.exists() && file_of(&own).exists());
        remove_abandoned(&namespace, Some(&own));
        assert!(!segment.exists() && !file_of(&other).exists() && file_of(&own).exists());
        drop(membership);
        assert!(remove_if_unused(&own) && !file_of(&own).exists());
        fs::remove_dir(&root).unwrap();
    }
}
