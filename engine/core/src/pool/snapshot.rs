//! The whole state of one environment as bytes.
//!
//! A snapshot is `EGYM`, the format's version (u32), the CRC-32 of what follows (u32), both little-endian, and then the
//! environment in [postcard](https://postcard.jamesmunns.com)'s encoding: id, reset parameters as JSON, generator, seeding,
//! sums of the running episode, and the family's state.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::seeding::SavedSeeds;
use crate::envs::{InvalidState, ParameterError};
use crate::random::Generator;

const MAGIC: [u8; 4] = *b"EGYM";
const HEAD: usize = 12;

/// Version of the format. It changes with every change to what a snapshot holds.
pub const SNAPSHOT_VERSION: u32 = 1;

/// What a snapshot holds.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Saved<S> {
    pub id: String,
    /// The reset parameters that were given, as a JSON object.
    pub options: String,
    pub random: Generator,
    pub seeds: SavedSeeds,
    pub episode_return: f64,
    pub episode_length: i32,
    pub ended: bool,
    pub state: S,
}

impl<S: Serialize> Saved<S> {
    pub(super) fn to_bytes(&self) -> Result<Vec<u8>, SnapshotError> {
        let mut bytes = vec![0; HEAD];
        bytes = postcard::to_extend(self, bytes).map_err(|error| SnapshotError::Content(error.to_string()))?;
        let checksum = crc32fast::hash(&bytes[HEAD..]);
        bytes[..4].copy_from_slice(&MAGIC);
        bytes[4..8].copy_from_slice(&SNAPSHOT_VERSION.to_le_bytes());
        bytes[8..HEAD].copy_from_slice(&checksum.to_le_bytes());
        Ok(bytes)
    }
}

impl<S: DeserializeOwned> Saved<S> {
    pub(super) fn from_bytes(bytes: &[u8]) -> Result<Self, SnapshotError> {
        let (head, content) = bytes.split_at_checked(HEAD).ok_or(SnapshotError::NoSnapshot)?;
        let number = |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        if head[..4] != MAGIC {
            return Err(SnapshotError::NoSnapshot);
        }
        if number(4) != SNAPSHOT_VERSION {
            return Err(SnapshotError::Version { given: number(4) });
        }
        if number(8) != crc32fast::hash(content) {
            return Err(SnapshotError::Damaged);
        }
        let saved: Self = postcard::from_bytes(content).map_err(|error| SnapshotError::Content(error.to_string()))?;
        if saved.episode_length < 0 || !saved.episode_return.is_finite() {
            return Err(InvalidState.into());
        }
        Ok(saved)
    }
}

/// A snapshot that cannot be taken or gone on from. The environment is as it was.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum SnapshotError {
    #[error("there is no environment {given}; the pool has 0 to {}", num_envs - 1)]
    NoSuchEnvironment { given: usize, num_envs: usize },
    #[error("the environment was never reset, so that it has no state yet; reset it first")]
    NotReset,
    #[error("the bytes are no snapshot")]
    NoSnapshot,
    #[error("the snapshot is of version {given}, and this endless-gym reads version {SNAPSHOT_VERSION}; take it anew")]
    Version { given: u32 },
    #[error("the snapshot is damaged: its checksum does not fit")]
    Damaged,
    #[error("the snapshot's content cannot be read: {0}")]
    Content(String),
    #[error("the snapshot is of {given}, and the pool has {expected}")]
    OtherEnvironment { given: String, expected: &'static str },
    #[error("the snapshot's reset parameters: {0}")]
    Parameters(#[from] ParameterError),
    #[error("the snapshot's content is not valid: {0}")]
    State(#[from] InvalidState),
}
