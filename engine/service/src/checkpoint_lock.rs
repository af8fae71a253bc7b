//! The lock of a checkpoint file: two engines that saved to one file would overwrite each other's environments.

use std::fs::{self, File, TryLockError};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use crate::checkpoint_config::CheckpointError;
use crate::locked_file;

/// An engine's right to save to a checkpoint file: an `flock` on `FILE.lock`, since `FILE` itself is replaced by every save. The kernel
/// releases it when the process dies; the file that then stays is taken over by the next engine.
#[derive(Debug)]
pub(crate) struct CheckpointLock {
    file: File,
    path: PathBuf,
    process: u32,
}

impl CheckpointLock {
    /// Takes the lock of the checkpoint file `checkpoint`.
    pub(crate) fn acquire(checkpoint: &Path) -> Result<Self, CheckpointError> {
        let mut path = checkpoint.as_os_str().to_owned();
        path.push(".lock");
        let path = PathBuf::from(path);
        let failed = |e: std::io::Error| CheckpointError::Write {
            path: checkpoint.to_owned(),
            reason: format!("{}: {e}", path.display()),
        };
        loop {
            let mut file = locked_file::open(&path, true).map_err(failed)?;
            match file.try_lock() {
                Ok(()) => {}
                Err(TryLockError::Error(e)) => return Err(failed(e)),
                Err(TryLockError::WouldBlock) => {
                    let mut text = String::new();
                    let process = file.read_to_string(&mut text).ok().and_then(|_| text.trim().parse().ok());
                    return Err(CheckpointError::InUse { path: checkpoint.to_owned(), process });
                }
            }
            // Otherwise an engine that ended has removed it in the meantime.
            if locked_file::is_same(&file, &path) {
                let process = std::process::id();
                file.set_len(0).and_then(|()| writeln!(file, "{process}")).map_err(failed)?;
                return Ok(CheckpointLock { file, path, process });
            }
        }
    }
}

impl Drop for CheckpointLock {
    fn drop(&mut self) {
        // In a forked process, the lock is the parent's.
        if self.process == std::process::id() {
            let _ = fs::remove_file(&self.path);
            // Closing the file is not enough: a forked child shares the lock.
            let _ = self.file.unlock();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_checkpoint_has_one_engine_at_a_time() {
        let folder = std::env::temp_dir().join(format!("endless-checkpoint-lock-{}", std::process::id()));
        fs::create_dir(&folder).unwrap();
        let path = folder.join("run.ckpt");
        let lock = CheckpointLock::acquire(&path).unwrap();
        let refused = CheckpointLock::acquire(&path).unwrap_err();
        assert_eq!(refused, CheckpointError::InUse { path: path.clone(), process: Some(std::process::id()) });
        let text = format!(
            "checkpoint {} is in use by another engine (process {}); stop it, or choose another file",
            path.display(),
            std::process::id()
        );
        assert_eq!(refused.to_string(), text);
        CheckpointLock::acquire(&folder.join("other.ckpt")).unwrap();
        drop(lock);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);

        // What a dead engine left, which may be longer than what is written.
        fs::write(folder.join("run.ckpt.lock"), "4294967295000\n").unwrap();
        drop(CheckpointLock::acquire(&path).unwrap());
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
        let missing = CheckpointLock::acquire(&folder.join("missing/run.ckpt")).unwrap_err();
        assert!(matches!(missing, CheckpointError::Write { .. }), "{missing}");
        fs::remove_dir(&folder).unwrap();
    }
}
