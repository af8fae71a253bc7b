//! The folder of a run, and the lock of the process that trains in it: the same file and the same `flock` as those of the Python agents.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{Read, Seek, SeekFrom, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use endless_gym_core::printable;

use crate::error::{Error, file};
use crate::settings::{SETTINGS, Settings};

/// File in the folder of a run while a process trains there. Its text says which process that is.
const LOCK: &str = "lock";

/// The folder of a run, locked. A folder that this process made is removed again if nothing has been written into it.
pub struct RunFolder {
    /// The folder.
    pub path: PathBuf,
    is_new: bool,
    _lock: File,
}

impl RunFolder {
    /// Makes the folder of a new run, or opens that of a run to resume, and locks it. Fails with [`Error::RunInUse`],
    /// [`Error::RunExists`], [`Error::NoRun`], and [`Error::File`].
    pub fn open(settings: &Settings) -> Result<Self, Error> {
        let path = match (&*settings.resume, &*settings.run) {
            ("", "") => new_folder(settings)?,
            ("", run) => PathBuf::from(run),
            (run, _) => PathBuf::from(run),
        };
        if !settings.resume.is_empty() && !path.join(SETTINGS).exists() {
            return Err(Error::NoRun { run: path });
        }
        let is_new = fs::read_dir(&path).map_or(true, |mut files| files.next().is_none());
        fs::create_dir_all(&path).map_err(file(&path))?;
        let opened = lock(&path).map(|lock| RunFolder { path: path.clone(), is_new, _lock: lock });
        if is_new && opened.is_err() {
            let _ = fs::remove_dir(&path);
        }
        let opened = opened?;
        if settings.resume.is_empty() && path.join(SETTINGS).exists() {
            return Err(Error::RunExists { run: path });
        }
        Ok(opened)
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        let _ = fs::remove_file(self.path.join(LOCK));
        if self.is_new {
            // Fails if it has files.
            let _ = fs::remove_dir(&self.path);
        }
    }
}

/// The current time in UTC, such as 2026-01-31 12:00:00.
fn now() -> String {
    text(SystemTime::now())
}

fn text(time: SystemTime) -> String {
    // Years before 1970, of a clock that was never set, have no such text.
    humantime::format_rfc3339_seconds(time.max(SystemTime::UNIX_EPOCH)).to_string().replace('T', " ").replace('Z', "")
}

/// Makes the folder of a run without a given one; runs that start in the same second get different folders.
fn new_folder(settings: &Settings) -> Result<PathBuf, Error> {
    let agent = serde_json::to_value(settings.agent).ok().and_then(|agent| Some(agent.as_str()?.to_owned()));
    let time = now().replace(['-', ':'], "").replace(' ', "-");
    let name = format!("{}-{}-{time}", agent.unwrap_or_default(), settings.seed);
    // A shell reads the `?` and `&` of an id with arguments otherwise.
    let parent = Path::new("runs").join(settings.env.replace(['?', '&'], "_"));
    fs::create_dir_all(&parent).map_err(file(&parent))?;
    for number in 1.. {
        let path = parent.join(if number == 1 { name.clone() } else { format!("{name}-{number}") });
        match fs::create_dir(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            made => return made.map(|()| path.clone()).map_err(file(&path)),
        }
    }
    unreachable!("there are more numbers than folders")
}

/// Locks a folder. The operating system releases the lock when the process ends for any reason.
fn lock(run: &Path) -> Result<File, Error> {
    let path = run.join(LOCK);
    loop {
        let mut lock = OpenOptions::new().read(true).append(true).create(true).open(&path).map_err(file(&path))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                let _ = lock.seek(SeekFrom::Start(0)).and_then(|_| lock.read_to_string(&mut holder));
                let holder = if holder.trim().is_empty() { "another process" } else { holder.trim() }.to_owned();
                return Err(Error::RunInUse { run: run.to_owned(), holder });
            }
            Err(TryLockError::Error(error)) => {
                let text = format!("{} cannot be locked ({error}); start only one run in it", run.display());
                eprintln!("{}", printable(text));
            }
        }
        if lock.metadata().map_err(file(&path))?.nlink() == 0 {
            continue; // The process that held the lock has removed the file.
        }
        let host = rustix::system::uname();
        let (process, host) = (std::process::id(), host.nodename().to_string_lossy());
        let text = format!("process {process} on {host} since {} UTC\n", now());
        let written = lock.set_len(0).and_then(|()| lock.write_all(text.as_bytes()));
        // On a full disk.
        return written.map(|()| lock).inspect_err(|_| drop(fs::remove_file(&path))).map_err(file(&path));
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_clock_before_1970_does_not_end_a_run() {
        let [before, after] = [text(SystemTime::UNIX_EPOCH - Duration::from_secs(9)), text(SystemTime::UNIX_EPOCH)];
        assert_eq!([before, after], ["1970-01-01 00:00:00"; 2]);
    }
}
