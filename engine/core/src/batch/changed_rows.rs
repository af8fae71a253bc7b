//! Which rows of a frame may have changed, and where.

use crate::envs::SCREEN;
use crate::raster::DirtySpans;

/// Rows of a frame that are described together.
pub(super) const BAND: usize = 8;

/// Bytes that describe a band.
pub(super) const BAND_BYTES: usize = 3;

/// Bytes that describe one frame of an observation.
pub(super) const FRAME_CHANGES_BYTES: usize = SCREEN.div_ceil(BAND) * BAND_BYTES;

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

/// The changes of a frame with these dirty pixels. Columns of the screen are the rows of a frame's array, unless it is row-major.
#[inline]
pub(crate) fn frame_changes(dirty: &DirtySpans, row_major: bool) -> FrameChanges {
    let mut changes = NOTHING;
    if row_major {
        changes_of_rows(dirty, &mut changes);
        return changes;
    }
    for (change, (firsts, ends)) in changes.as_chunks_mut::<BAND_BYTES>().0.iter_mut().zip(dirty.bands::<BAND>()) {
        if *ends != [0; BAND] {
            let first = firsts.iter().fold(u8::MAX, |all, first| all.min(*first));
            let end = ends.iter().fold(0, |all, end| all.max(*end));
            *change = [nonzero_bytes(*ends), first, end];
        }
    }
    changes
}

/// The changes of a row-major frame.
fn changes_of_rows(dirty: &DirtySpans, changes: &mut FrameChanges) {
    let spans = dirty.bands::<1>().map(|(&[first], &[end])| (usize::from(first), usize::from(end)));
    for (x, (first, end)) in spans.enumerate().filter(|(_, (first, end))| first < end) {
        for band in first / BAND..end.div_ceil(BAND) {
            let within = first.max(band * BAND) - band * BAND..end.min((band + 1) * BAND) - band * BAND;
            let change = &mut changes[band * BAND_BYTES..][..BAND_BYTES];
            if change[0] == 0 {
                change[1] = x as u8;
            }
            change[0] |= u8::MAX >> (BAND - within.len()) << within.start;
            change[2] = x as u8 + 1;
        }
    }
}

/// A bit for each byte that is not 0.
#[inline]
fn nonzero_bytes(bytes: [u8; BAND]) -> u8 {
    const LOW: u64 = 0x7f7f_7f7f_7f7f_7f7f;
    let bytes = u64::from_le_bytes(bytes);
    // The highest bit of each byte that is not 0, and the product that gathers them.
    let highest = (((bytes & LOW) + LOW) | bytes) & !LOW;
    ((highest >> 7).wrapping_mul(0x0102_0408_1020_4080) >> 56) as u8
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::raster::Canvas;

    /// The pixels of a frame's array that these changes name.
    fn named(changes: &FrameChanges) -> Vec<(usize, usize)> {
        let bands = changes.as_chunks::<BAND_BYTES>().0.iter().enumerate();
        let rows = bands.flat_map(|(band, &[rows, start, end])| {
            let named = (0..BAND).filter(move |row| rows >> row & 1 != 0).map(move |row| band * BAND + row);
            named.filter(|row| *row < SCREEN).map(move |row| (row, start..end))
        });
        rows.flat_map(|(row, pixels)| pixels.map(move |pixel| (row, pixel.into()))).collect()
    }

    #[test]
    fn everything_and_nothing_are_what_they_say() {
        assert_eq!(named(&EVERYTHING).len(), SCREEN * SCREEN);
        for row_major in [false, true] {
            let all: Vec<_> = (0..SCREEN).flat_map(|x| [(x, 0), (x, SCREEN - 1)]).collect();
            assert_eq!(named(&frame_changes(&painted(&all), row_major)).len(), SCREEN * SCREEN);
            assert_eq!(frame_changes(&painted(&[]), row_major), NOTHING);
        }
    }

    /// What is noted when these pixels are painted.
    fn painted(pixels: &[(usize, usize)]) -> DirtySpans {
        let (mut frame, mut dirty) = (vec![0; SCREEN * SCREEN * 3], DirtySpans::new());
        let mut canvas = Canvas::new(&mut frame, SCREEN, SCREEN).tracking_spans(&mut dirty);
        pixels.iter().for_each(|(x, y)| *canvas.pixel_mut(*x, *y) = [1; 3]);
        dirty
    }

    proptest! {
        /// Every dirty pixel is named; in a band, the named rows and the ends of the span have dirty pixels.
        #[test]
        fn dirty_pixels_are_named(pixels in prop::collection::vec((0..SCREEN, 0..SCREEN), 0..6), row_major: bool) {
            let changed: Vec<_> = pixels.iter().map(|&(x, y)| if row_major { (y, x) } else { (x, y) }).collect();
            let changes = frame_changes(&painted(&pixels), row_major);
            let named = named(&changes);
            prop_assert!(changed.iter().all(|pixel| named.contains(pixel)));
            for (row, pixel) in named {
                // The pixels of a column are noted as a span.
                let near = |changed: &(usize, usize)| changed.0 / BAND == row / BAND || row_major;
                let band: Vec<_> = changed.iter().filter(|changed| near(changed)).collect();
                prop_assert!(row_major || band.iter().any(|changed| changed.0 == row));
                prop_assert!(band.iter().any(|changed| changed.1 <= pixel) && band.iter().any(|changed| changed.1 >= pixel));
            }
        }
    }
}
