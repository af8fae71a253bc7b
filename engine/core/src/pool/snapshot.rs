//! The complete state of one environment as bytes.
//!
//! A snapshot starts with `EGYM`, the version of the format (u32), and the CRC-32 of the content (u32), both little-endian. The
//! content is encoded with [postcard](https://postcard.jamesmunns.com): id, reset parameters as JSON, seed, generator, seeding,
//! return and length of the running episode, and the family's state.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::env_panic::EnvPanic;
use super::seeding::SavedSeeds;
use crate::envs::{InvalidState, ParameterError};
use crate::random::Generator;

const MAGIC: [u8; 4] = *b"EGYM";
/// Bytes of the magic, the version and the checksum.
pub(crate) const HEAD: usize = 12;

/// Version of the snapshot format. It changes with every change to the content.
pub const SNAPSHOT_VERSION: u32 = 3;

/// The content of a snapshot.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Saved<S> {
    pub id: String,
    /// The reset parameters that were given, as a JSON object.
    pub options: String,
    /// The reset parameters of the next episode, if others were set.
    pub next_options: Option<String>,
    /// The seed that the running episode started with.
    pub episode_seed: Option<u64>,
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

/// A snapshot cannot be taken or restored. Except for [`SnapshotError::Panic`], the environment has not changed.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum SnapshotError {
    /// The pool has no environment with this number.
    #[error("env must be 0 to {}, got {given}", num_envs - 1)]
    NoSuchEnv { given: usize, num_envs: usize },
    /// The environments have no state before their first reset.
    #[error("all environments must be reset before a snapshot is taken or restored")]
    NotReset,
    /// There are too few bytes, or they do not start with `EGYM`.
    #[error("the bytes are not a snapshot")]
    NoSnapshot,
    /// The snapshot was taken by a version of this crate with another snapshot format.
    #[error("the snapshot must be of version {SNAPSHOT_VERSION}, got version {given}; take it again")]
    Version { given: u32 },
    /// The checksum differs.
    #[error("the snapshot is damaged: its checksum differs")]
    Damaged,
    /// The content cannot be encoded or decoded.
    #[error("the snapshot's content cannot be read: {0}")]
    Content(String),
    /// The snapshot belongs to another environment id.
    #[error("the snapshot must be of {expected}, got {given}")]
    OtherEnvironment { given: String, expected: &'static str },
    /// The earlier frames of a stacked observation, which a checkpoint stores beside the snapshot, have the wrong length.
    #[error("the earlier frames must have {expected} bytes, got {given}")]
    EarlierFrames { given: usize, expected: usize },
    /// The snapshot's reset parameters are invalid.
    #[error("the snapshot's reset parameters: {0}")]
    Parameters(#[from] ParameterError),
    /// The environment cannot be in the snapshot's state.
    #[error("the snapshot's content is not valid: {0}")]
    State(#[from] InvalidState),
    /// The environment panicked. After a restore, all environments must be reset before any other call.
    #[error(transparent)]
    Panic(#[from] EnvPanic),
}

/// The state of one environment of a pool, as [`Pool::save`](super::Pool::save) returns it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SavedEnv {
    /// The environment's snapshot.
    #[serde(with = "serde_bytes")]
    pub snapshot: Vec<u8>,
    /// All frames of a stacked observation except the newest, oldest first, in the pool's format.
    #[serde(with = "serde_bytes")]
    pub earlier_frames: Vec<u8>,
}

/// A pool cannot continue from a saved state.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum ResumeError {
    /// The number of environments differs.
    #[error("the saved state must have {num_envs} environments, got {given}")]
    Count { given: usize, num_envs: usize },
    /// The state of an environment is invalid.
    #[error("environment {env}: {source}")]
    Environment { env: usize, source: SnapshotError },
}
