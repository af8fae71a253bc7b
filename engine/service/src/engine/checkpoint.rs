//! Checkpoint files: an engine saves its environments, and a later engine resumes from them.
//!
//! A checkpoint is `EGYC`, the format's version (u32), the CRC-32 of the content (u32), both little-endian, and then
//! the content in [postcard](https://postcard.jamesmunns.com)'s encoding: a JSON text that describes the environments,
//! and for each group its step and its environments' states.

use std::fs::{self, File, TryLockError};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{self, Mutex};
use std::thread::JoinHandle;
use std::time::Instant;

use endless_gym_core::batch::Frames;
use endless_gym_core::files;
use endless_gym_core::pool::{SavedEnv, Seeding};
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value as Json};

use crate::engine::config::{CheckpointConfig, EngineConfig};
use crate::engine::group::{Group, Groups};
use crate::engine::status_writer::StatusWriter;
use crate::error::{CHECKPOINT_VERSION, CheckpointError, PACKAGE_VERSION};
use crate::namespace::locked_file;
use crate::protocol::specification::ServiceSpecification;
use crate::protocol::status_file::now;
use crate::protocol::wait::lock;

const MAGIC: [u8; 4] = *b"EGYC";
const PREAMBLE: usize = 12;

/// What must be the same in the engine that saves and in the one that resumes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct CheckpointHead {
    package: String,
    id: String,
    num_envs: usize,
    groups: usize,
    autoreset: String,
    frames: Option<Frames>,
    features: bool,
    /// The source of the seeds, without its initial seed: its current state is part of the environments' states.
    seeding: String,
    options: Vec<Map<String, Json>>,
}

impl CheckpointHead {
    pub(crate) fn new(config: &EngineConfig, specification: &ServiceSpecification) -> Self {
        let seeding = match &config.pool.seeding {
            Seeding::Continue { .. } if config.pool.independent_episodes => "a drawn seed for each episode".to_owned(),
            Seeding::Continue { .. } => "continued generators".to_owned(),
            Seeding::Range { start, end, step, .. } => format!("seeds drawn from {start}..{end}:{step}"),
            Seeding::List(seeds) => {
                format!(
                    "a list of {} seeds with checksum {:08x}",
                    seeds.len(),
                    crc32fast::hash(bytemuck::cast_slice(seeds))
                )
            }
        };
        // Part of the text, so that the format of earlier checkpoints stays valid.
        let independent = if config.pool.independent_episodes { ", independent episodes" } else { "" };
        CheckpointHead {
            package: PACKAGE_VERSION.to_owned(),
            id: specification.id.clone(),
            num_envs: specification.num_envs,
            groups: specification.groups,
            autoreset: specification.autoreset.name().to_owned(),
            frames: specification.frames,
            features: config.pool.features,
            seeding: seeding + independent,
            options: specification.options.clone(),
        }
    }

    /// The first property that differs, its value in `self` and in `other`.
    fn difference(&self, other: &Self) -> Option<(&'static str, String, String)> {
        let text = |head: &Self| {
            [
                ("the environment", head.id.clone()),
                ("num_envs", head.num_envs.to_string()),
                ("groups", head.groups.to_string()),
                ("autoreset", head.autoreset.clone()),
                ("frames", format!("{:?}", head.frames)),
                ("features", head.features.to_string()),
                ("the seeding", head.seeding.clone()),
                ("the reset parameters", Json::from_iter(head.options.iter().cloned().map(Json::from)).to_string()),
            ]
        };
        let mut pairs = text(self).into_iter().zip(text(other));
        pairs.find(|(own, others)| own != others).map(|((what, own), (_, others))| (what, own, others))
    }
}

/// The saved state of one group.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct SavedGroup {
    /// Batches that the group has returned.
    pub step: u64,
    /// `None` before its first reset.
    pub envs: Option<Vec<SavedEnv>>,
}

#[derive(Serialize, Deserialize)]
struct Content {
    head: String,
    groups: Vec<SavedGroup>,
}

/// Writes a checkpoint. It replaces an earlier one only when it is complete and on disk.
pub(crate) fn write(path: &Path, head: &CheckpointHead, groups: Vec<SavedGroup>) -> Result<(), CheckpointError> {
    let failed = |reason: String| CheckpointError::Write { path: path.to_owned(), reason };
    let head = serde_json::to_string(head).map_err(|e| failed(e.to_string()))?;
    let mut bytes = vec![0; PREAMBLE];
    bytes = postcard::to_extend(&Content { head, groups }, bytes).map_err(|e| failed(e.to_string()))?;
    let checksum = crc32fast::hash(&bytes[PREAMBLE..]);
    bytes[..4].copy_from_slice(&MAGIC);
    bytes[4..8].copy_from_slice(&CHECKPOINT_VERSION.to_le_bytes());
    bytes[8..PREAMBLE].copy_from_slice(&checksum.to_le_bytes());
    files::replace(path, &bytes).map_err(|e| failed(e.to_string()))
}

/// Checks early that a checkpoint can be written.
pub(crate) fn check_writable(path: &Path) -> Result<(), CheckpointError> {
    files::check_replaceable(path).map_err(|e| CheckpointError::Write { path: path.to_owned(), reason: e.to_string() })
}

/// Reads the groups of a checkpoint saved with this head; `None` if there is no file.
pub(crate) fn read(path: &Path, head: &CheckpointHead) -> Result<Option<Vec<SavedGroup>>, CheckpointError> {
    let bytes = match files::read(path) {
        Ok(bytes) => bytes,
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(CheckpointError::Read { path: path.to_owned(), reason: e.to_string() }),
    };
    decode(path, &bytes, head).map(Some)
}

fn decode(path: &Path, bytes: &[u8], head: &CheckpointHead) -> Result<Vec<SavedGroup>, CheckpointError> {
    let path = || path.to_owned();
    let damaged = |reason: &dyn ToString| CheckpointError::Damaged { path: path(), reason: reason.to_string() };
    let (preamble, content) =
        bytes.split_at_checked(PREAMBLE).ok_or_else(|| CheckpointError::NoCheckpoint { path: path() })?;
    let number = |at: usize| u32::from_le_bytes([preamble[at], preamble[at + 1], preamble[at + 2], preamble[at + 3]]);
    if preamble[..4] != MAGIC {
        return Err(CheckpointError::NoCheckpoint { path: path() });
    }
    if number(4) != CHECKPOINT_VERSION {
        return Err(CheckpointError::Version { path: path(), given: number(4) });
    }
    if number(8) != crc32fast::hash(content) {
        return Err(damaged(&"its checksum differs"));
    }
    let (content, rest) = postcard::take_from_bytes::<Content>(content).map_err(|e| damaged(&e))?;
    if !rest.is_empty() {
        return Err(damaged(&"it has bytes after its end"));
    }
    let saved: CheckpointHead = serde_json::from_str(&content.head).map_err(|e| damaged(&e))?;
    if let Some((what, saved, given)) = saved.difference(head) {
        return Err(CheckpointError::Mismatch { path: path(), what, saved, given });
    }
    if content.groups.len() != head.groups {
        return Err(damaged(&"the number of its groups differs from its head"));
    }
    Ok(content.groups)
}

/// Saves the environments of an engine. A periodic checkpoint stalls the engine only while it copies their states:
/// another thread encodes and writes them.
#[derive(Debug)]
pub(crate) struct Checkpointer {
    config: CheckpointConfig,
    head: CheckpointHead,
    /// Those of the process; `None` if they cannot be read.
    cpus: Option<CpuSet>,
    /// Whether a request was executed since the last checkpoint.
    changed: AtomicBool,
    /// Held while the states of the groups are copied. A thread that uses a group must not wait for it.
    saving: Mutex<Saving>,
    // Released after the last write.
    _lock: CheckpointLock,
}

#[derive(Debug)]
struct Saving {
    last: Instant,
    writing: Option<JoinHandle<Result<(), CheckpointError>>>,
}

impl Checkpointer {
    pub(crate) fn new(config: &CheckpointConfig, head: CheckpointHead) -> Result<Self, CheckpointError> {
        if config.every.is_some_and(|every| every.is_zero()) {
            return Err(CheckpointError::Interval);
        }
        // First: another engine may be about to create the file.
        let lock = CheckpointLock::acquire(&config.path)?;
        if !config.resume && config.path.exists() {
            return Err(CheckpointError::Exists { path: config.path.clone() });
        }
        check_writable(&config.path)?;
        Ok(Checkpointer {
            config: config.clone(),
            head,
            cpus: sched_getaffinity(None).ok(),
            changed: AtomicBool::new(false),
            saving: Mutex::new(Saving { last: Instant::now(), writing: None }),
            _lock: lock,
        })
    }

    /// Continues from the file, if the configuration asks for it and the file exists.
    pub(crate) fn resume(&self, groups: &mut [Group], status: &StatusWriter) -> Result<(), CheckpointError> {
        let path = &self.config.path;
        let Some(saved) = self.config.resume.then(|| read(path, &self.head)).transpose()?.flatten() else {
            return Ok(());
        };
        for (number, (group, SavedGroup { step, envs })) in groups.iter_mut().zip(saved).enumerate() {
            if let Some(envs) = envs {
                group.resume(&envs).map_err(|source| CheckpointError::Group {
                    path: path.clone(),
                    group: number,
                    source,
                })?;
            }
            status.update_group(number, |group| group.step = step);
        }
        tracing::info!(path = %path.display(), "resumed from a checkpoint");
        Ok(())
    }

    /// A request was executed.
    pub(crate) fn mark_changed(&self) {
        self.changed.store(true, Ordering::SeqCst);
    }

    /// Saves in the background if a checkpoint is due.
    pub(crate) fn poll(&self, groups: &Groups, status: &StatusWriter) {
        // While a trainer has a checkpoint saved, its groups are busy anyway.
        let mut saving = match self.saving.try_lock() {
            Ok(saving) => saving,
            Err(sync::TryLockError::Poisoned(saving)) => saving.into_inner(),
            Err(sync::TryLockError::WouldBlock) => return,
        };
        if saving.writing.as_ref().is_some_and(JoinHandle::is_finished)
            && let Err(e) = self.finish(&mut saving, status)
        {
            tracing::error!(error = %e, "cannot save a checkpoint");
        }
        let is_due = self.config.every.is_some_and(|every| saving.last.elapsed() >= every);
        if !is_due || saving.writing.is_some() || !self.changed.swap(false, Ordering::SeqCst) {
            return;
        }
        saving.last = Instant::now();
        let saved = match save(groups, status) {
            Ok(saved) => saved,
            // No group was reset.
            Err(CheckpointError::NotReset) => return,
            Err(e) => {
                self.mark_changed();
                return tracing::error!(error = %e, "cannot save a checkpoint");
            }
        };
        let (path, head, cpus) = (self.config.path.clone(), self.head.clone(), self.cpus);
        let thread = std::thread::Builder::new().name("checkpoint".to_owned());
        let write = move || {
            // Not on the CPU of the thread that starts this one, if that is bound to it.
            let _ = cpus.map(|cpus| sched_setaffinity(None, &cpus));
            write(&path, &head, saved)
        };
        match thread.spawn(write) {
            Ok(writing) => saving.writing = Some(writing),
            Err(e) => {
                self.mark_changed();
                tracing::error!(error = %e, "cannot start a thread to save a checkpoint");
            }
        }
    }

    /// Saves now, and returns the saved step of each group when the checkpoint is on disk. The caller must not use a group.
    pub(crate) fn save(&self, groups: &Groups, status: &StatusWriter) -> Result<Vec<u64>, CheckpointError> {
        let mut saving = lock(&self.saving);
        if let Err(e) = self.finish(&mut saving, status) {
            tracing::warn!(error = %e, "cannot save a checkpoint");
        }
        // First: what other threads execute from now on may be missing.
        let changed = self.changed.swap(false, Ordering::SeqCst);
        let saved = save(groups, status).and_then(|saved| {
            let steps = saved.iter().map(|group| group.step).collect();
            write(&self.config.path, &self.head, saved).map(|()| steps)
        });
        match &saved {
            Ok(_) => {
                saving.last = Instant::now();
                self.saved(status);
            }
            Err(_) => drop(self.changed.fetch_or(changed, Ordering::SeqCst)),
        }
        saved
    }

    /// Saves what has changed since the last checkpoint, when the engine stops.
    pub(crate) fn stop(&self, groups: &Groups, status: &StatusWriter) -> Result<(), CheckpointError> {
        let unfinished = self.finish(&mut lock(&self.saving), status);
        let is_needed = self.changed.load(Ordering::SeqCst) || unfinished.is_err();
        if is_needed { self.save(groups, status).map(drop) } else { Ok(()) }
    }

    /// Waits for the thread that writes.
    fn finish(&self, saving: &mut Saving, status: &StatusWriter) -> Result<(), CheckpointError> {
        let Some(writing) = saving.writing.take() else { return Ok(()) };
        let failed = |_| CheckpointError::Write { path: self.config.path.clone(), reason: "it panicked".to_owned() };
        let written = writing.join().map_err(failed).and_then(|written| written);
        match written {
            Ok(()) => self.saved(status),
            Err(_) => self.mark_changed(),
        }
        written
    }

    fn saved(&self, status: &StatusWriter) {
        tracing::info!(path = %self.config.path.display(), "saved a checkpoint");
        status.update_engine(|engine| (engine.checkpoints, engine.last_checkpoint) = (engine.checkpoints + 1, now()));
    }
}

impl Drop for Checkpointer {
    fn drop(&mut self) {
        // The end of the process would interrupt the thread.
        if let Some(writing) = lock(&self.saving).writing.take() {
            let _ = writing.join();
        }
    }
}

/// The states of all groups.
fn save(groups: &Groups, status: &StatusWriter) -> Result<Vec<SavedGroup>, CheckpointError> {
    let save =
        |number| groups.visit(number, |group| group.save().map(|envs| SavedGroup { step: status.step(number), envs }));
    let saved: Result<Vec<_>, _> = (0..groups.len()).map(save).collect();
    let saved = saved.map_err(|source| CheckpointError::State { source })?;
    if saved.iter().all(|group| group.envs.is_none()) { Err(CheckpointError::NotReset) } else { Ok(saved) }
}

/// An engine's right to save to a checkpoint file: an `flock` on `FILE.lock`, since `FILE` itself is replaced by every
/// save. The kernel releases it when the process dies; the next engine then takes over the lock file.
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
            // If they differ, an engine that ended has removed the file in the meantime.
            if locked_file::is_same(&file, &path) {
                let process = std::process::id();
                // Removes the file if the disk is full.
                let mut lock = CheckpointLock { file, path: path.clone(), process };
                lock.file.set_len(0).and_then(|()| writeln!(lock.file, "{process}")).map_err(failed)?;
                return Ok(lock);
            }
        }
    }
}

impl Drop for CheckpointLock {
    fn drop(&mut self) {
        // A forked child must not release its parent's lock.
        if self.process == std::process::id() {
            let _ = fs::remove_file(&self.path);
            // Closing the file is not enough: a forked child shares the lock.
            let _ = self.file.unlock();
        }
    }
}

#[cfg(test)]
mod tests {
    use endless_gym_core::batch::zeroed;
    use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
    use endless_gym_memory_gym::memory_gym;
    use proptest::prelude::*;

    use super::*;

    /// A head and the file of a checkpoint of two groups, one of which was not reset.
    fn checkpoint(name: &str) -> (CheckpointHead, Vec<u8>) {
        let path = std::env::temp_dir().join(format!("endless-checkpoint-{name}-{}", std::process::id()));
        let mut pool =
            Pool::new(memory_gym(), &PoolConfig::new("MysteryPath-Grid-v0", 2), &Threads::new(1).unwrap()).unwrap();
        pool.reset(ResetRequest::Seed(1), &mut zeroed(pool.layout().blocks())).unwrap();
        let groups = vec![SavedGroup { step: 7, envs: pool.save().unwrap() }, SavedGroup { step: 0, envs: None }];
        let head = CheckpointHead {
            package: PACKAGE_VERSION.to_owned(),
            id: "MysteryPath-Grid-v0".to_owned(),
            num_envs: 2,
            groups: 2,
            autoreset: "next_step".to_owned(),
            frames: None,
            features: false,
            seeding: "continued generators".to_owned(),
            options: vec![Map::new()],
        };
        write(&path, &head, groups.clone()).unwrap();
        assert_eq!(read(&path, &head).unwrap(), Some(groups));
        let bytes = fs::read(&path).unwrap();
        fs::remove_file(&path).unwrap();
        assert_eq!(read(&path, &head).unwrap(), None);
        (head, bytes)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]

        #[test]
        fn an_altered_checkpoint_is_never_accepted(
            changes in prop::collection::vec((any::<prop::sample::Index>(), 1..=255u8), 1..4),
        ) {
            let (head, original) = checkpoint("altered");
            let mut bytes = original.clone();
            for (at, change) in changes {
                *at.get_mut(&mut bytes) ^= change;
            }
            prop_assume!(bytes != original);
            prop_assert!(decode(Path::new("file"), &bytes, &head).is_err());
        }

        /// With a matching checksum, so that the content reaches the decoder.
        #[test]
        fn a_forged_checkpoint_does_not_panic(
            changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..9),
            length in any::<prop::sample::Index>(),
            cut: bool,
        ) {
            let (head, mut bytes) = checkpoint("forged");
            for (at, value) in changes {
                *at.get_mut(&mut bytes[PREAMBLE..]) = value;
            }
            if cut {
                bytes.truncate(PREAMBLE + length.index(bytes.len() - PREAMBLE));
            }
            let checksum = crc32fast::hash(&bytes[PREAMBLE..]);
            bytes[8..PREAMBLE].copy_from_slice(&checksum.to_le_bytes());
            if let Ok(groups) = decode(Path::new("file"), &bytes, &head) {
                let config = PoolConfig::new("MysteryPath-Grid-v0", 2);
                let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).unwrap();
                for group in groups {
                    let _ = group.envs.map(|envs| pool.resume(&envs));
                }
            }
        }
    }

    #[test]
    fn errors_tell_foreign_files_from_checkpoints_of_other_environments() {
        let (head, bytes) = checkpoint("foreign");
        let message =
            |bytes: &[u8], head: &CheckpointHead| decode(Path::new("/a/b"), bytes, head).unwrap_err().to_string();
        for foreign in [&b"PK\x03\x04 something else"[..], b"EGYC"] {
            assert_eq!(message(foreign, &head), "/a/b is not a checkpoint of an engine");
        }
        let mut newer = bytes.clone();
        newer[4] = 9;
        assert!(message(&newer, &head).contains("must be of version 1, got version 9"));
        let mut damaged = bytes.clone();
        *damaged.last_mut().unwrap() ^= 1;
        assert_eq!(message(&damaged, &head), "checkpoint /a/b is damaged: its checksum differs");
        let other = CheckpointHead { num_envs: 5, ..head.clone() };
        assert_eq!(message(&bytes, &other), "checkpoint /a/b was saved with num_envs 2, and the engine has 5");
        let newer_package = CheckpointHead { package: "99.0.0".to_owned(), ..head };
        decode(Path::new("file"), &bytes, &newer_package).unwrap();
    }

    #[test]
    fn only_one_engine_at_a_time_uses_a_checkpoint() {
        let folder = std::env::temp_dir().join(format!("endless-checkpoint-lock-{}", std::process::id()));
        fs::create_dir(&folder).unwrap();
        let path = folder.join("run.ckpt");
        let lock = CheckpointLock::acquire(&path).unwrap();
        let refused = CheckpointLock::acquire(&path).unwrap_err();
        assert_eq!(refused, CheckpointError::InUse { path: path.clone(), process: Some(std::process::id()) });
        CheckpointLock::acquire(&folder.join("other.ckpt")).unwrap();
        drop(lock);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);

        // A dead engine's lock file, longer than what replaces it.
        fs::write(folder.join("run.ckpt.lock"), "4294967295000\n").unwrap();
        drop(CheckpointLock::acquire(&path).unwrap());
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
        let missing = CheckpointLock::acquire(&folder.join("missing/run.ckpt")).unwrap_err();
        assert!(matches!(missing, CheckpointError::Write { .. }), "{missing}");
        fs::remove_dir(&folder).unwrap();
    }
}
