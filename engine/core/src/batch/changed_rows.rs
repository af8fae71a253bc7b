//! Which rows of a frame may have changed, and where.

use crate::envs::SCREEN;

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

/// The changes of a frame with these dirty pixels: for each column of the screen a bit for each row. Columns of the screen are the
/// rows of a frame's array, unless it is row-major.
pub(crate) fn frame_changes(dirty: &[u128; SCREEN], row_major: bool) -> FrameChanges {
    let mut changes = NOTHING;
    for (number, change) in changes.as_chunks_mut::<BAND_BYTES>().0.iter_mut().enumerate() {
        *change = if row_major { band_of_rows(dirty, number * BAND) } else { band_of_columns(&dirty[number * BAND..]) };
    }
    changes
}

/// The first of these columns of the screen as a band.
#[inline]
fn band_of_columns(columns: &[u128]) -> [u8; BAND_BYTES] {
    let (mut rows, mut union) = (0, 0);
    for (number, column) in columns.iter().take(BAND).enumerate() {
        rows |= u8::from(*column != 0) << number;
        union |= column;
    }
    if union == 0 { [0; 3] } else { [rows, union.trailing_zeros() as u8, (u128::BITS - union.leading_zeros()) as u8] }
}

/// The rows of the screen from `first` on as a band.
fn band_of_rows(dirty: &[u128; SCREEN], first: usize) -> [u8; BAND_BYTES] {
    let (mut rows, mut start, mut end) = (0, 0, 0);
    for (x, column) in dirty.iter().enumerate() {
        let bits = (column >> first) as u8;
        if bits != 0 {
            (start, end) = (if rows == 0 { x } else { start }, x + 1);
            rows |= bits;
        }
    }
    [rows, start as u8, end as u8]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

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
            assert_eq!(named(&frame_changes(&[u128::MAX >> (128 - SCREEN); SCREEN], row_major)).len(), SCREEN * SCREEN);
            assert_eq!(frame_changes(&[0; SCREEN], row_major), NOTHING);
        }
    }

    proptest! {
        /// Every dirty pixel is named; in a band, the named rows and the ends of the span have dirty pixels.
        #[test]
        fn dirty_pixels_are_named(pixels in prop::collection::vec((0..SCREEN, 0..SCREEN), 0..6), row_major: bool) {
            let mut dirty = [0; SCREEN];
            pixels.iter().for_each(|(x, y)| dirty[*x] |= 1 << y);
            let changed: Vec<_> = pixels.iter().map(|&(x, y)| if row_major { (y, x) } else { (x, y) }).collect();
            let changes = frame_changes(&dirty, row_major);
            let named = named(&changes);
            prop_assert!(changed.iter().all(|pixel| named.contains(pixel)));
            for (row, pixel) in named {
                let band: Vec<_> = changed.iter().filter(|changed| changed.0 / BAND == row / BAND).collect();
                prop_assert!(band.iter().any(|changed| changed.0 == row));
                prop_assert!(band.iter().any(|changed| changed.1 <= pixel) && band.iter().any(|changed| changed.1 >= pixel));
            }
        }
    }
}
