//! The file from which an engine continues the environments of an earlier one.
//!
//! A checkpoint is `EGYC`, the format's version (u32), the CRC-32 of what follows (u32), both little-endian, and then the content
//! in [postcard](https://postcard.jamesmunns.com)'s encoding: what the environments are, as JSON text, and for each group its step and
//! its environments' states.

use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use endless_gym_core::batch::Frames;
use endless_gym_core::pool::{SavedEnv, Seeding};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value as Json};

use crate::checkpoint_config::{CHECKPOINT_VERSION, CheckpointError};
use crate::engine_config::EngineConfig;
use crate::error::PACKAGE_VERSION;
use crate::specification::ServiceSpecification;

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
    /// The source of the seeds, without the seed that it started from: its state is part of the environments' states.
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
        // Part of the text, so that the format is that of earlier checkpoints.
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

/// Writes a checkpoint and replaces an earlier one when it is complete and on the disk.
pub(crate) fn write(path: &Path, head: &CheckpointHead, groups: Vec<SavedGroup>) -> Result<(), CheckpointError> {
    let failed = |reason: String| CheckpointError::Write { path: path.to_owned(), reason };
    let head = serde_json::to_string(head).map_err(|e| failed(e.to_string()))?;
    let mut bytes = vec![0; PREAMBLE];
    bytes = postcard::to_extend(&Content { head, groups }, bytes).map_err(|e| failed(e.to_string()))?;
    let checksum = crc32fast::hash(&bytes[PREAMBLE..]);
    bytes[..4].copy_from_slice(&MAGIC);
    bytes[4..8].copy_from_slice(&CHECKPOINT_VERSION.to_le_bytes());
    bytes[8..PREAMBLE].copy_from_slice(&checksum.to_le_bytes());
    let new = new_path(path);
    let written = File::create(&new).and_then(|mut file| file.write_all(&bytes).and_then(|()| file.sync_all()));
    let replaced = written.and_then(|()| fs::rename(&new, path));
    replaced.and_then(|()| File::open(directory(path))?.sync_all()).map_err(|e| {
        let _ = fs::remove_file(&new);
        failed(e.to_string())
    })
}

/// Checks that a checkpoint can be written, so that this is not found out at the first one.
pub(crate) fn check_writable(path: &Path) -> Result<(), CheckpointError> {
    let new = new_path(path);
    let created = if path.is_dir() { Err(ErrorKind::IsADirectory.into()) } else { File::create(&new).map(drop) };
    created
        .and_then(|()| fs::remove_file(&new))
        .map_err(|e| CheckpointError::Write { path: path.to_owned(), reason: e.to_string() })
}

/// Reads the groups of a checkpoint that was saved with this head; `None` if there is no file.
pub(crate) fn read(path: &Path, head: &CheckpointHead) -> Result<Option<Vec<SavedGroup>>, CheckpointError> {
    let bytes = match fs::read(path) {
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

fn new_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".new");
    name.into()
}

fn directory(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
#[path = "checkpoint_tests.rs"]
mod tests;
