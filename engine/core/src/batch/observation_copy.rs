//! A reader's own copy of the observations, which follows the batches of a pool.

use thiserror::Error;

use super::block::{Block, blocks_for, zeroed};
use super::changed_rows::{BAND, BAND_BYTES};
use super::layout::Layout;
use super::sections::BatchSection;
use super::stamp::Stamp;
use super::view::Batch;
use crate::raster::copy_run;

/// A copy of the observations of a pool's batches, of which each update copies only what has changed.
///
/// The pool must note changes ([`PoolConfig::changes`](crate::pool::PoolConfig::changes)), or every update copies everything. So
/// does the first update, and one that follows a batch that was left out, was written by another pool, or was changed since.
///
/// ```
/// use endless_gym_core::batch::{Batch, ObservationCopy, zeroed};
/// use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
///
/// let config = PoolConfig { changes: true, ..PoolConfig::new("MysteryPath-Grid-v0", 8) };
/// let mut pool = Pool::new(&config, &Threads::new(1)?)?;
/// let mut blocks = zeroed(pool.layout().blocks());
/// let mut copy = ObservationCopy::new(pool.layout())?;
/// pool.reset(ResetRequest::Seed(1), &mut blocks)?;
/// assert_eq!(copy.apply(&Batch::new(pool.layout(), &blocks))?, 8 * 84 * 84 * 3);
///
/// pool.step(&[2; 8], &mut blocks)?;
/// let batch = Batch::new(pool.layout(), &blocks);
/// assert!(copy.apply(&batch)? < 8 * 84 * 84 * 3);
/// assert_eq!(copy.observations(), batch.observation());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct ObservationCopy {
    updater: ObservationUpdater,
    /// Aligned to cache lines, as the observations of a batch.
    blocks: Vec<Block>,
}

impl ObservationCopy {
    /// A copy for batches of that layout, of zeros before the first [`apply`](Self::apply).
    ///
    /// # Errors
    ///
    /// [`ObservationCopyError::NoObservation`] if batches of that layout have no frames.
    pub fn new(layout: &Layout) -> Result<Self, ObservationCopyError> {
        let updater = ObservationUpdater::new(layout)?;
        Ok(ObservationCopy { blocks: zeroed(blocks_for(updater.bytes())), updater })
    }

    /// Makes the copy equal to the batch's observations. Returns the number of bytes that were copied.
    ///
    /// # Errors
    ///
    /// [`ObservationCopyError::Size`] if the observations have another size than those of the layout.
    pub fn apply(&mut self, batch: &Batch<'_>) -> Result<usize, ObservationCopyError> {
        self.updater.update(batch, &mut bytemuck::cast_slice_mut(&mut self.blocks)[..self.updater.bytes()])
    }

    /// The observations of the last batch, in the order of the section `observation`.
    pub fn observations(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.blocks)[..self.updater.bytes()]
    }
}

/// Updates a copy of observations that lies in memory of the caller, who writes to it in no other way; see [`ObservationCopy`].
#[derive(Clone, Debug)]
pub struct ObservationUpdater {
    bytes: usize,
    frames: FrameShape,
    /// Bytes of the changes of one frame; `None` if the layout does not describe them.
    described: Option<usize>,
    /// The stamp of the batch that the copy equals; that of no batch before the first update.
    stamp: Stamp,
}

/// The frames of all environments as arrays of rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct FrameShape {
    /// Bytes of a frame.
    frame: usize,
    /// Planes of a frame; more than 1 if the channel is the first index.
    planes: usize,
    /// Rows of a plane.
    rows: usize,
    /// Bytes of a row.
    row: usize,
    /// Bytes of a pixel in a row.
    pixel: usize,
}

impl FrameShape {
    /// The frames of observations of that shape, of which `stack` are one observation.
    fn new(shape: &[usize], stack: usize) -> Option<Self> {
        let shape = match shape {
            [first, rest @ ..] if stack > 1 && *first == stack => rest,
            shape => shape,
        };
        let (planes, rows, columns, pixel) = match *shape {
            [rows, columns] => (1, rows, columns, 1),
            [rows, columns, 3] => (1, rows, columns, 3),
            [3, rows, columns] => (3, rows, columns, 1),
            _ => return None,
        };
        let frame = FrameShape { frame: planes * rows * columns * pixel, planes, rows, row: columns * pixel, pixel };
        (frame.frame > 0).then_some(frame)
    }
}

impl ObservationUpdater {
    /// For batches of that layout.
    ///
    /// # Errors
    ///
    /// [`ObservationCopyError::NoObservation`] if batches of that layout have no frames.
    pub fn new(layout: &Layout) -> Result<Self, ObservationCopyError> {
        let observation = layout.section(BatchSection::Observation).ok_or(ObservationCopyError::NoObservation)?;
        let (bytes, shape) = (observation.bytes(), observation.shape());
        // A layout of another process may describe other frames than it has. Then every update copies everything.
        let described = layout.section(BatchSection::ChangedRows).and_then(|changes| {
            // With as many numbers as the observation has rows, a frame is one observation; otherwise there is a stack of them.
            let (whole, stacked) = (FrameShape::new(shape, 1), FrameShape::new(shape, shape.first().copied()?));
            [(whole, 1), (stacked, shape.first().copied()?)].into_iter().find_map(|(frame, stack)| {
                let frame = frame?;
                let size = frame.rows.div_ceil(BAND) * BAND_BYTES;
                (frame.row / frame.pixel <= usize::from(u8::MAX) && changes.width() == size.checked_mul(stack)?)
                    .then_some((frame, size))
            })
        });
        let whole = FrameShape { frame: bytes, planes: 1, rows: 1, row: bytes, pixel: 1 };
        let rows = FrameShape::new(shape, 1).or_else(|| FrameShape::new(shape, shape.first().copied().unwrap_or(1)));
        let frames = described.map_or(rows.unwrap_or(whole), |(frame, _)| frame);
        Ok(ObservationUpdater { bytes, frames, described: described.map(|(_, size)| size), stamp: Stamp::default() })
    }

    /// Bytes of all observations.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Bytes of a row, for [`update_and_list`](Self::update_and_list). A row is contiguous in memory; the first index of a frame
    /// without its channels selects it.
    pub fn row_bytes(&self) -> usize {
        self.frames.row
    }

    /// Forgets the batch that the copy equals, such that the next update copies everything. Required after any other change to the
    /// copy.
    pub fn forget(&mut self) {
        self.stamp = Stamp::default();
    }

    /// Makes `copy` equal to the batch's observations. Returns the number of bytes that were copied.
    ///
    /// # Errors
    ///
    /// [`ObservationCopyError::Size`] if the observations or `copy` have another size than those of the layout.
    pub fn update(&mut self, batch: &Batch<'_>, copy: &mut [u8]) -> Result<usize, ObservationCopyError> {
        self.update_with(batch, copy, |_| ())
    }

    /// As [`update`](Self::update). Replaces the content of `rows` by the numbers of the rows that were copied to, in parts or as a
    /// whole, in ascending order: row `n` is the bytes from `n * row_bytes` on.
    ///
    /// # Errors
    ///
    /// As [`update`](Self::update).
    pub fn update_and_list(
        &mut self,
        batch: &Batch<'_>,
        copy: &mut [u8],
        rows: &mut Vec<usize>,
    ) -> Result<usize, ObservationCopyError> {
        rows.clear();
        let row = self.frames.row.max(1);
        let is_sorted = self.frames.planes == 1;
        let copied = self.update_with(batch, copy, |bytes| rows.extend(bytes.start / row..bytes.end.div_ceil(row)))?;
        if !is_sorted {
            rows.sort_unstable();
        }
        Ok(copied)
    }

    /// Calls `copied` with every range of bytes that is copied.
    #[inline]
    fn update_with(
        &mut self,
        batch: &Batch<'_>,
        copy: &mut [u8],
        mut copied: impl FnMut(std::ops::Range<usize>),
    ) -> Result<usize, ObservationCopyError> {
        let observations = batch.observation();
        for given in [observations.len(), copy.len()] {
            if given != self.bytes {
                return Err(ObservationCopyError::Size { given, expected: self.bytes });
            }
        }
        let stamp = batch.stamp();
        let before = std::mem::replace(&mut self.stamp, stamp);
        if stamp == before && stamp != Stamp::default() {
            return Ok(0);
        }
        let changes = batch.changed_rows();
        let size = self.described.filter(|size| changes.len() / size * self.frames.frame == self.bytes);
        let (Some(size), true) = (size, stamp.follows(before)) else {
            copy.copy_from_slice(observations);
            copied(0..self.bytes);
            return Ok(self.bytes);
        };
        let FrameShape { frame, planes, rows, row, pixel } = self.frames;
        let (mut sum, mut start) = (0, 0);
        for changes in changes.chunks_exact(size) {
            for (band, &[bits, first, end]) in changes.as_chunks::<BAND_BYTES>().0.iter().enumerate() {
                if bits == 0 {
                    continue;
                }
                // The description may come from another process, which may write anything.
                let end = (usize::from(end) * pixel).min(row);
                let first = (usize::from(first) * pixel).min(end);
                for plane in 0..planes {
                    let from = start + (plane * rows + band * BAND) * row;
                    let in_band = (rows - band * BAND).min(BAND);
                    let mut rest = bits & (u8::MAX >> (BAND - in_band));
                    if rest.count_ones() as usize == in_band && end - first == row {
                        let bytes = from..from + in_band * row;
                        copy[bytes.clone()].copy_from_slice(&observations[bytes.clone()]);
                        sum += bytes.len();
                        copied(bytes);
                        continue;
                    }
                    while rest != 0 {
                        let from = from + rest.trailing_zeros() as usize * row;
                        let bytes = from + first..from + end;
                        copy_run(&observations[bytes.clone()], &mut copy[bytes.clone()]);
                        sum += bytes.len();
                        copied(bytes);
                        rest &= rest - 1;
                    }
                }
            }
            start += frame;
        }
        Ok(sum)
    }
}

/// A copy of observations cannot be made or updated.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum ObservationCopyError {
    /// Batches of the layout have no frames.
    #[error("a copy of observations needs a batch with the section `observation`")]
    NoObservation,
    /// The observations or the memory of the copy have another size than those of the layout.
    #[error("observations and their copy must have {expected} bytes, got {given}")]
    Size {
        /// The size that was given.
        given: usize,
        /// The size of the layout's observations.
        expected: usize,
    },
}
