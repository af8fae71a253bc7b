//! Files that processes lock with `flock` and remove when they leave.

use std::fs::{self, File};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use rustix::fs::OFlags;

/// Opens the file without truncating it. `create` creates it if it is missing, readable only by its owner. A symbolic
/// link is an error, and a FIFO does not block.
pub(crate) fn open(path: &Path, create: bool) -> io::Result<File> {
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits().cast_signed();
    File::options().read(true).write(true).create(create).truncate(false).mode(0o600).custom_flags(flags).open(path)
}

/// Whether the open file is still at that path: the process that held its lock may have removed it.
pub(crate) fn is_same(file: &File, path: &Path) -> bool {
    let at = |data: fs::Metadata| (data.dev(), data.ino());
    match (file.metadata(), fs::symlink_metadata(path)) {
        (Ok(open), Ok(named)) => at(open) == at(named),
        _ => false,
    }
}
