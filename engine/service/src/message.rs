//! The headers of the messages between trainer and engine. Their payload is `[Block]`: actions, a batch or a snapshot.

use bytemuck::{Pod, Zeroable};
use iceoryx2::prelude::ZeroCopySend;

use super::error::Rejection;
use endless_gym_core::batch::{Block, LAYOUT_VERSION};

/// A [`Block`] as the payload of a message.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(transparent)]
pub(super) struct PayloadBlock(Block);

// SAFETY: a block is 64 plain bytes in `repr(C)`, without pointers or handles, alike in every process.
unsafe impl ZeroCopySend for PayloadBlock {
    unsafe fn type_name() -> &'static str {
        "endless_gym::Block"
    }
}

/// What a trainer asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// A step with the payload's `action`.
    Step,
    /// An episode for every environment, seeded by the engine's policy.
    ResetAll,
    /// An episode for every environment, seeded from the header's `seed` on.
    ResetSeed,
    /// Episodes as the payload's `reset` and `seed` say.
    ResetEach,
    /// The state of environment `env`, for its snapshot.
    Snapshot,
    /// Environment `env` goes on from the payload's `snapshot`.
    Restore,
}

impl Kind {
    const ALL: [Kind; 6] =
        [Kind::Step, Kind::ResetAll, Kind::ResetSeed, Kind::ResetEach, Kind::Snapshot, Kind::Restore];

    /// The number in the header; 0 is none of them.
    pub(super) fn code(self) -> u32 {
        self as u32 + 1
    }

    pub(super) fn from_code(code: u32) -> Option<Self> {
        Kind::ALL.into_iter().find(|kind| kind.code() == code)
    }

    /// Whether the answer is a batch, and not a snapshot.
    pub(super) fn yields_batch(self) -> bool {
        !matches!(self, Kind::Snapshot | Kind::Restore)
    }
}

/// Header of a message from the trainer.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[type_name("endless_gym::ActionHeader")]
#[repr(C)]
pub(super) struct ActionHeader {
    pub layout_version: u32,
    /// A [`Kind`].
    pub kind: u32,
    /// The engine's epoch that the trainer knows; the engine drops messages of any other.
    pub epoch: u64,
    /// Number of the trainer, drawn when it connects.
    pub trainer: u64,
    /// Number of the message; the answer repeats it.
    pub request: u64,
    /// First seed of a [`Kind::ResetSeed`].
    pub seed: u64,
    /// Environment of a [`Kind::Snapshot`] or a [`Kind::Restore`].
    pub env: u64,
    /// Bytes of the payload's `options` (JSON text, for a reset with other reset parameters; 0: with the same) or `snapshot`.
    pub bytes: u64,
}

/// Bytes of the text in an [`ObservationHeader`].
const TEXT_BYTES: usize = 192;

/// The status of an answer that holds a batch.
const BATCH: u32 = 0;

/// The status of an answer whose payload starts with a snapshot. All others are rejections.
const SNAPSHOT: u32 = u32::MAX;

/// Header of a batch from the engine, of a snapshot, or of a rejection.
#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("endless_gym::ObservationHeader")]
#[repr(C)]
pub(super) struct ObservationHeader {
    pub layout_version: u32,
    pub group: u32,
    pub epoch: u64,
    /// Batches that the group has yielded since the engine started, this one included.
    pub step: u64,
    /// Trainer and number of the message that this answers.
    pub trainer: u64,
    pub request: u64,
    /// [`BATCH`], [`SNAPSHOT`] or a [`Rejection`], whose payload means nothing.
    status: u32,
    text_length: u32,
    text: [u8; TEXT_BYTES],
    /// Bytes of a snapshot; none answer a [`Kind::Restore`].
    snapshot: u64,
}

impl Default for ObservationHeader {
    fn default() -> Self {
        ObservationHeader {
            layout_version: LAYOUT_VERSION,
            group: 0,
            epoch: 0,
            step: 0,
            trainer: 0,
            request: 0,
            status: BATCH,
            text_length: 0,
            text: [0; TEXT_BYTES],
            snapshot: 0,
        }
    }
}

impl ObservationHeader {
    /// The header of the batch that answers `request`.
    pub(super) fn answering(request: &ActionHeader, group: usize, epoch: u64, step: u64) -> Self {
        let (trainer, request) = (request.trainer, request.request);
        ObservationHeader { group: group as u32, epoch, step, trainer, request, ..ObservationHeader::default() }
    }

    /// Makes a snapshot of that many bytes the answer.
    pub(super) fn hold_snapshot(&mut self, bytes: usize) {
        (self.status, self.snapshot) = (SNAPSHOT, bytes as u64);
    }

    pub(super) fn is_batch(&self) -> bool {
        self.status == BATCH
    }

    /// Bytes of the snapshot, if the answer is one.
    pub(super) fn snapshot(&self) -> Option<usize> {
        (self.status == SNAPSHOT).then_some(self.snapshot as usize)
    }

    /// Turns the answer into a rejection.
    pub(super) fn reject(&mut self, reason: Rejection, message: &str) {
        let longest = message.len().min(TEXT_BYTES);
        let end = (0..=longest).rev().find(|end| message.is_char_boundary(*end)).unwrap_or(0);
        self.status = reason.status();
        self.text_length = end as u32;
        self.text[..end].copy_from_slice(&message.as_bytes()[..end]);
    }

    /// Why the engine rejected the message, if it did.
    pub(super) fn rejection(&self) -> Option<(Rejection, String)> {
        let text = self.text.get(..self.text_length as usize).unwrap_or_default();
        let message = String::from_utf8_lossy(text).into_owned();
        let rejected = self.status != BATCH && self.status != SNAPSHOT;
        rejected.then(|| (Rejection::from_status(self.status).unwrap_or(Rejection::Kind), message))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_survive_the_header() {
        for kind in Kind::ALL {
            assert_eq!(Kind::from_code(kind.code()), Some(kind));
        }
        assert_eq!(Kind::from_code(0), None);
    }

    #[test]
    fn a_rejection_keeps_what_fits_of_its_text() {
        let mut header = ObservationHeader::default();
        assert_eq!(header.rejection(), None);
        header.reject(Rejection::Pool, &"ä".repeat(200));
        assert_eq!(header.rejection(), Some((Rejection::Pool, "ä".repeat(TEXT_BYTES / 2))));
        header.text_length = u32::MAX;
        assert_eq!(header.rejection(), Some((Rejection::Pool, String::new())));
    }
}
