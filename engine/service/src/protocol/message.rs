//! The headers of requests and responses. The payload of both is `[Block]`: actions, a batch or a snapshot.
//!
//! A sender can change a header in shared memory at any time. A receiver must copy it once with [`copied`], check the
//! copy, and use only the copy.

use bytemuck::{CheckedBitPattern, Pod, Zeroable};
use endless_gym_core::batch::{Block, LAYOUT_VERSION};
use endless_gym_core::pool::EnvReset;
use endless_gym_core::printable;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::Rejection;

/// A [`Block`] as the payload element of a message.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(transparent)]
pub(crate) struct PayloadBlock(Block);

// SAFETY: a block is 64 plain bytes in `repr(C)` without pointers or handles, so every process reads the same value.
unsafe impl ZeroCopySend for PayloadBlock {
    unsafe fn type_name() -> &'static str {
        "endless_gym::Block"
    }
}

/// Copies a header out of shared memory.
pub(crate) fn copied<H: Copy>(header: &H) -> H {
    // SAFETY: a reference is valid for reads and aligned, and `H` is `Copy`. The read is volatile, so that the compiler
    // does not replace uses of the copy with further reads of shared memory.
    unsafe { std::ptr::read_volatile(header) }
}

/// What a trainer requests. 0 is not a kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, CheckedBitPattern)]
#[repr(u32)]
pub(crate) enum RequestKind {
    /// Step all environments with the payload's `action`.
    Step = 1,
    /// Start an episode in every environment, seeded by the pool's seeding.
    ResetAll,
    /// Start an episode in every environment; environment `i` of the engine is seeded with the header's `seed + i`.
    ResetSeed,
    /// Start episodes as given by the payload's `reset` and `seed`.
    ResetEach,
    /// Return a snapshot of environment `env`.
    Snapshot,
    /// Restore environment `env` from the payload's `snapshot`.
    Restore,
    /// Save all groups to the engine's checkpoint file and return their steps.
    Checkpoint,
    /// Set the options of next episodes from the JSON text in the payload's `snapshot`.
    SetOptions,
    /// Return the seeds and options of the running episodes of the environments in the payload's `reset`.
    Episodes,
}

impl RequestKind {
    /// The code in the header.
    pub(crate) fn code(self) -> u32 {
        self as u32
    }

    /// A word for the kind, for people.
    pub(crate) fn name(self) -> &'static str {
        match self {
            RequestKind::Step => "step",
            RequestKind::ResetAll | RequestKind::ResetSeed | RequestKind::ResetEach => "reset",
            RequestKind::Snapshot => "snapshot",
            RequestKind::Restore => "restore",
            RequestKind::Checkpoint => "checkpoint",
            RequestKind::SetOptions => "options",
            RequestKind::Episodes => "episodes",
        }
    }

    /// The kind with that code.
    pub(crate) fn from_code(code: u32) -> Option<Self> {
        bytemuck::checked::try_cast(code).ok()
    }

    /// Whether the response holds a batch and not a snapshot or text.
    pub(crate) fn returns_batch(self) -> bool {
        use RequestKind::{ResetAll, ResetEach, ResetSeed, Step};
        matches!(self, Step | ResetAll | ResetSeed | ResetEach)
    }

    /// Whether it leaves all environments unchanged.
    pub(crate) fn changes_nothing(self) -> bool {
        matches!(self, RequestKind::Snapshot | RequestKind::Checkpoint | RequestKind::Episodes)
    }
}

/// Header of a message from the trainer.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[type_name("endless_gym::RequestHeader")]
#[repr(C)]
pub(crate) struct RequestHeader {
    pub layout_version: u32,
    /// Code of a [`RequestKind`].
    pub kind: u32,
    /// Incarnation of the engine that the trainer is connected to. The engine drops requests for another one.
    pub incarnation: u64,
    /// Random number of the trainer, drawn when it connects.
    pub trainer: u64,
    /// Number of the request; the response repeats it.
    pub request: u64,
    /// First seed of a [`RequestKind::ResetSeed`].
    pub seed: u64,
    /// Environment of a [`RequestKind::Snapshot`] or a [`RequestKind::Restore`].
    pub env: u64,
    /// Length in bytes of the payload's `options` (JSON text of a reset; 0: keep the reset parameters) or of what its `snapshot`
    /// holds.
    pub bytes: u64,
    /// Process id of the trainer, for people.
    pub process: u32,
    /// Batches of the group that the trainer holds, for people.
    pub held: u32,
}

/// The items of the sections `reset` and `seed` of a request.
pub(crate) fn encode_reset(reset: EnvReset) -> (u8, u64) {
    match reset {
        EnvReset::Keep => (0, 0),
        EnvReset::Next => (1, 0),
        EnvReset::Seed(seed) => (2, seed),
    }
}

/// The reset of these items.
pub(crate) fn decode_reset(reset: u8, seed: u64) -> EnvReset {
    match reset {
        0 => EnvReset::Keep,
        1 => EnvReset::Next,
        _ => EnvReset::Seed(seed),
    }
}

/// Status of a response that holds a batch.
const BATCH: u32 = 0;

/// Status of a response whose payload starts with a snapshot or other bytes that are not a batch. All other numbers are
/// rejections.
const SNAPSHOT: u32 = u32::MAX;

/// What a response holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ResponseContent {
    Batch,
    /// A snapshot, steps or JSON text of that many bytes; 0 bytes in the response to a [`RequestKind::Restore`] or a
    /// [`RequestKind::SetOptions`].
    Snapshot {
        bytes: usize,
    },
    /// The explanation is that many bytes of text at the start of the payload.
    Rejection {
        reason: Rejection,
        bytes: usize,
    },
}

/// Header of a message from the engine.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[type_name("endless_gym::ResponseHeader")]
#[repr(C)]
pub(crate) struct ResponseHeader {
    pub layout_version: u32,
    pub group: u32,
    pub incarnation: u64,
    /// Batches that the group has returned since the engine started, including this one.
    pub step: u64,
    /// The trainer and the number of the request that this message answers.
    pub trainer: u64,
    pub request: u64,
    /// Length in bytes of the snapshot, or of the text of a rejection.
    bytes: u64,
    /// [`BATCH`], [`SNAPSHOT`] or the status of a [`Rejection`].
    status: u32,
    padding: u32,
}

impl ResponseHeader {
    /// The header of the batch that answers `request`.
    pub(crate) fn answering(request: &RequestHeader, group: usize, incarnation: u64, step: u64) -> Self {
        let RequestHeader { trainer, request, .. } = *request;
        let (layout_version, group) = (LAYOUT_VERSION, group as u32);
        ResponseHeader { layout_version, group, incarnation, step, trainer, request, ..ResponseHeader::default() }
    }

    /// Turns the response into a snapshot of that many bytes.
    pub(crate) fn set_snapshot(&mut self, bytes: usize) {
        (self.status, self.bytes) = (SNAPSHOT, bytes as u64);
    }

    /// Turns the response into a rejection whose explanation has that many bytes.
    pub(crate) fn set_rejection(&mut self, reason: Rejection, bytes: usize) {
        (self.status, self.bytes) = (reason.status(), bytes as u64);
    }

    /// What the response holds.
    pub(crate) fn content(&self) -> ResponseContent {
        let bytes = usize::try_from(self.bytes).unwrap_or(usize::MAX);
        match self.status {
            BATCH => ResponseContent::Batch,
            SNAPSHOT => ResponseContent::Snapshot { bytes },
            status => {
                ResponseContent::Rejection { reason: Rejection::from_status(status).unwrap_or(Rejection::Kind), bytes }
            }
        }
    }
}

/// Writes the explanation of a rejection into the payload of a response, cut between characters if it does not fit, and returns its
/// length in bytes.
pub(crate) fn write_text(payload: &mut [Block], text: &str) -> usize {
    let memory: &mut [u8] = bytemuck::cast_slice_mut(payload);
    let longest = text.len().min(memory.len());
    let end = (0..=longest).rev().find(|end| text.is_char_boundary(*end)).unwrap_or(0);
    memory[..end].copy_from_slice(&text.as_bytes()[..end]);
    end
}

/// The explanation of a rejection; empty if its length is beyond the payload.
pub(crate) fn read_text(payload: &[Block], bytes: usize) -> String {
    let memory: &[u8] = bytemuck::cast_slice(payload);
    printable(String::from_utf8_lossy(memory.get(..bytes).unwrap_or_default()))
}

#[cfg(test)]
mod layout_tests;

#[cfg(test)]
mod tests {
    use endless_gym_core::batch::zeroed;

    use super::*;

    #[test]
    fn the_text_of_a_rejection_is_cut_between_characters_at_the_end_of_the_payload() {
        let mut payload = zeroed(3);
        for (given, kept) in [
            ("ab", "ab"),
            ("", ""),
            (&"ä".repeat(200), &*"ä".repeat(96)),
            (&format!("x{}", "ä".repeat(200)), &format!("x{}", "ä".repeat(95))),
        ] {
            let bytes = write_text(&mut payload, given);
            assert_eq!(read_text(&payload, bytes), kept);
        }
        assert_eq!(read_text(&payload, 193), "");
        assert_eq!(read_text(&payload, usize::MAX), "");
    }
}
