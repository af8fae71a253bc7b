//! Which rows of a frame may have changed, and where.

use crate::envs::SCREEN;
use crate::raster::DirtyBands;

/// Rows of a frame that are described together.
pub(super) const BAND: usize = DirtyBands::BAND;

/// Bytes that describe a band.
pub(super) const BAND_BYTES: usize = 3;

/// Bands of a frame.
const BANDS: usize = SCREEN.div_ceil(BAND);

/// Bytes that describe one frame of an observation.
pub(super) const FRAME_CHANGES_BYTES: usize = BANDS * BAND_BYTES;

/// What may have changed in a frame. For each band of rows of its array: a bit for each row, the first pixel, and the one behind the
/// last. An array whose first index is the channel has the same changes in each of its planes.
pub(crate) type FrameChanges = [u8; FRAME_CHANGES_BYTES];

/// No row.
pub(crate) const NOTHING: FrameChanges = [0; FRAME_CHANGES_BYTES];

/// Every pixel of every row.
pub(crate) const EVERYTHING: FrameChanges = {
    let mut changes = NOTHING;
    let mut at = 0;
    while at < FRAME_CHANGES_BYTES {
        changes[at] = u8::MAX;
        changes[at + 2] = SCREEN as u8;
        at += BAND_BYTES;
    }
    changes
};

/// The changes of a frame with these dirty pixels.
#[inline]
pub(crate) fn frame_changes(dirty: &DirtyBands) -> FrameChanges {
    let mut changes = NOTHING;
    changes.as_chunks_mut::<BAND_BYTES>().0.copy_from_slice(&dirty.bands()[..BANDS]);
    changes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::Canvas;

    #[test]
    fn everything_and_nothing_are_what_a_canvas_notes() {
        for row_major in [false, true] {
            let mut dirty = DirtyBands::new(row_major);
            assert_eq!(frame_changes(&dirty), NOTHING);
            let mut frame = vec![0; SCREEN * SCREEN * 3];
            Canvas::new(&mut frame, SCREEN, SCREEN).tracking_bands(&mut dirty).fill([1; 3]);
            let named = |changes: &FrameChanges| {
                let bands = changes.as_chunks::<BAND_BYTES>().0.iter().enumerate();
                let rows = |(band, [bits, ..]): (usize, &[u8; BAND_BYTES])| {
                    let bits = *bits;
                    (0..BAND).filter(move |row| bits >> row & 1 != 0 && band * BAND + row < SCREEN).count()
                };
                bands.map(|band| (rows(band), band.1[1], band.1[2])).collect::<Vec<_>>()
            };
            assert_eq!(named(&frame_changes(&dirty)), named(&EVERYTHING));
        }
    }
}
