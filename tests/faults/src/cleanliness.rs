//! Finds what a round leaves behind: processes, files in the namespace's directory, and segments with its prefix.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

use endless_gym_service::{Namespace, ROOT_VARIABLE, running_engines};
use rustix::fs::{AtFlags, CWD, Timespec, Timestamps, utimensat};

/// How long removal may take, even on a busy machine.
const LIMIT: Duration = Duration::from_secs(60);

/// The files of a namespace: those in its directory and its segments.
pub fn files(namespace: &Namespace) -> Vec<PathBuf> {
    let mut found = Vec::new();
    below(namespace.root(), &mut found);
    let segments = fs::read_dir("/dev/shm").into_iter().flatten().flatten().map(|entry| entry.path());
    found
        .extend(segments.filter(|path| {
            path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(namespace.prefix()))
        }));
    found
}

/// Where a round's runs of `endless learn` have their files.
pub fn run(namespace: &Namespace) -> PathBuf {
    namespace.root().with_extension("run")
}

/// The file with the configuration of a round's engine.
pub fn config(namespace: &Namespace) -> PathBuf {
    namespace.root().with_extension("json")
}

/// Finds the files in a folder and its subfolders.
pub fn below(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => below(&entry.path(), found),
            _ => found.push(entry.path()),
        }
    }
}

/// The processes of a namespace other than this one: those with its directory in their environment variables.
pub fn processes(namespace: &Namespace) -> Vec<u32> {
    let variable = format!("{ROOT_VARIABLE}={}", namespace.root().display());
    let ids = fs::read_dir("/proc").into_iter().flatten().flatten();
    let ids = ids.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    ids.filter(|id| *id != std::process::id())
        .filter(|id| {
            let environment = fs::read(format!("/proc/{id}/environ")).unwrap_or_default();
            environment.split(|byte| *byte == 0).any(|entry| entry == variable.as_bytes())
        })
        .collect()
}

/// What is left after all processes have ended and one has listed the engines.
pub fn leftovers(namespace: &Namespace) -> Vec<String> {
    let start = Instant::now();
    loop {
        // A killed process may take a while to end.
        let processes = processes(namespace).into_iter().map(|id| format!("process {id}"));
        let error = running_engines(namespace).err().map(|error| format!("engines cannot be listed: {error}"));
        let files = files(namespace).into_iter().map(|path| path.display().to_string());
        let left: Vec<String> = processes.chain(error).chain(files).collect();
        if left.is_empty() || start.elapsed() >= LIMIT {
            return left;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Moves the modification times of a namespace's files and directories to `seconds` from now.
pub fn set_age(namespace: &Namespace, seconds: i64) {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let time = Timespec { tv_sec: now.as_secs() as i64 + seconds, tv_nsec: 0 };
    let times = Timestamps { last_access: time, last_modification: time };
    let files = files(namespace);
    let folders = files.iter().filter_map(|path| path.parent()).filter(|folder| folder.starts_with(namespace.root()));
    for path in files.iter().map(PathBuf::as_path).chain(folders) {
        // Sockets cannot be opened, so the times are set by path.
        let _ = utimensat(CWD, path, &times, AtFlags::SYMLINK_NOFOLLOW);
    }
}

/// Removes everything, whatever it is.
pub fn remove_all(namespace: &Namespace) {
    for path in files(namespace).into_iter().chain([config(namespace)]) {
        let _ = fs::remove_file(path);
    }
    for folder in [namespace.root(), &run(namespace)] {
        let _ = fs::remove_dir_all(folder);
    }
}
