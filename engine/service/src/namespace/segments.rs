//! The files in `/dev/shm`: shared memory segments, and the status files of engines and observers.

use std::fs::{self, File};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, OFlags, flock};

pub(crate) const DIRECTORY: &str = "/dev/shm";

/// Suffixes of the status files of engines and of observers.
pub(crate) const STATUS_SUFFIX: &str = ".status";
pub(crate) const OBSERVER_SUFFIX: &str = ".observer";

/// The path of a file.
pub(crate) fn path(name: &str) -> PathBuf {
    Path::new(DIRECTORY).join(name)
}

/// The files whose names start with `prefix` and end with `suffix`.
pub(crate) fn named(prefix: &str, suffix: &str) -> Vec<PathBuf> {
    let is_named = |name: &str| name.starts_with(prefix) && name.ends_with(suffix);
    let entries = fs::read_dir(DIRECTORY).into_iter().flatten().flatten();
    let named = entries.filter(|entry| entry.file_name().to_str().is_some_and(is_named));
    named.map(|entry| entry.path()).collect()
}

/// Opens a status file of this user for reading.
pub(crate) fn open_status(path: &Path) -> Option<File> {
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits();
    let file = File::options().read(true).custom_flags(flags.cast_signed()).open(path).ok()?;
    let metadata = file.metadata().ok()?;
    (metadata.is_file() && metadata.uid() == rustix::process::getuid().as_raw()).then_some(file)
}

/// Whether the process that writes a status file is running: it holds an exclusive lock on the file.
pub(crate) fn has_writer(status: &File) -> bool {
    // A shared lock: with an exclusive one, others would take this process for the writer.
    let is_locked = flock(status, FlockOperation::NonBlockingLockShared).is_err();
    if !is_locked {
        let _ = flock(status, FlockOperation::Unlock);
    }
    is_locked
}

/// Removes the status files of dead engines and observers.
pub(crate) fn remove_abandoned_status(prefix: &str) {
    for path in named(prefix, STATUS_SUFFIX).into_iter().chain(named(prefix, OBSERVER_SUFFIX)) {
        if open_status(&path).is_some_and(|file| !has_writer(&file)) {
            tracing::debug!(path = %path.display(), "removing the status of a dead process");
            // An error means that another process has removed it.
            let _ = fs::remove_file(&path);
        }
    }
}
