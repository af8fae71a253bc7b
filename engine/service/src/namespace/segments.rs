//! The files in `/dev/shm`: shared memory segments, the status files of engines and observers, and the files of viewers.

use std::fs::{self, File};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, OFlags, flock};

pub(crate) const DIRECTORY: &str = "/dev/shm";

/// Suffixes of the status files of engines and of observers, and of the files of viewers.
pub(crate) const STATUS_SUFFIX: &str = ".status";
pub(crate) const OBSERVER_SUFFIX: &str = ".observer";
pub(crate) const PICTURE_SUFFIX: &str = ".picture";

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
    open_own(path, false)
}

/// Opens a file of this user for reading, and perhaps for writing.
pub(crate) fn open_own(path: &Path, write: bool) -> Option<File> {
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits();
    let file = File::options().read(true).write(write).custom_flags(flags.cast_signed()).open(path).ok()?;
    let metadata = file.metadata().ok()?;
    (metadata.is_file() && metadata.uid() == rustix::process::getuid().as_raw()).then_some(file)
}

/// Whether the process that created a status file or a viewer's file is running: it holds an exclusive lock on the file.
pub(crate) fn has_writer(file: &File) -> bool {
    // A shared lock: with an exclusive one, others would take this process for the writer.
    let is_locked = flock(file, FlockOperation::NonBlockingLockShared).is_err();
    if !is_locked {
        let _ = flock(file, FlockOperation::Unlock);
    }
    is_locked
}

/// Removes the files of dead engines, observers and viewers.
pub(crate) fn remove_abandoned_status(prefix: &str) {
    for path in [STATUS_SUFFIX, OBSERVER_SUFFIX, PICTURE_SUFFIX].into_iter().flat_map(|suffix| named(prefix, suffix)) {
        if open_status(&path).is_some_and(|file| !has_writer(&file)) {
            tracing::debug!(path = %path.display(), "removing the file of a dead process");
            // An error means that another process has removed it.
            let _ = fs::remove_file(&path);
        }
    }
}
