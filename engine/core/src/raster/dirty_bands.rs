//! Dirty tracking by bands of a frame's array: the dirty rows of each band, and one span of pixels for them.

use std::ops::Range;

/// What may have been painted on a canvas. Columns of the canvas are the rows of a frame's array, unless it is row-major.
#[derive(Clone, Debug)]
pub struct DirtyBands {
    /// A bit for each row, the first pixel, and the one behind the last; zeros in a band without a dirty row.
    bands: [[u8; 3]; DirtyBands::SIDE / DirtyBands::BAND],
    row_major: bool,
}

impl DirtyBands {
    /// Rows in a band.
    pub const BAND: usize = 8;

    /// Maximum width and height of the canvas.
    pub const SIDE: usize = 128;

    /// No dirty pixel.
    #[inline]
    pub fn new(row_major: bool) -> Self {
        DirtyBands { bands: [[0; 3]; Self::SIDE / Self::BAND], row_major }
    }

    /// The bands, from the first row on.
    #[inline]
    pub fn bands(&self) -> &[[u8; 3]] {
        &self.bands
    }

    /// Marks some rows of some columns.
    #[inline]
    pub(super) fn mark(&mut self, columns: &Range<usize>, rows: &Range<usize>) {
        let (rows, pixels) = if self.row_major { (rows, columns) } else { (columns, rows) };
        if rows.start >= rows.end || pixels.start >= pixels.end {
            return;
        }
        let (start, end) = (pixels.start as u8, pixels.end as u8);
        let (first, last) = (rows.start / Self::BAND, (rows.end - 1) / Self::BAND);
        let mut bits = u8::MAX << (rows.start % Self::BAND);
        let bits_of_last = u8::MAX >> (Self::BAND - 1 - (rows.end - 1) % Self::BAND);
        for band in &mut self.bands[first..last] {
            merge(band, [bits, start, end]);
            bits = u8::MAX;
        }
        merge(&mut self.bands[last], [bits & bits_of_last, start, end]);
    }

    /// Marks a span of rows in each column: from `firsts` to the row before `ends`, which is 0 in a column without a dirty pixel.
    #[inline]
    pub(super) fn mark_spans(&mut self, firsts: &[u8], ends: &[u8]) {
        if self.row_major {
            let spans = firsts.iter().zip(ends).map(|(first, end)| usize::from(*first)..usize::from(*end));
            return spans.enumerate().for_each(|(x, rows)| self.mark(&(x..x + 1), &rows));
        }
        for ((band, firsts), ends) in self.bands.iter_mut().zip(firsts.chunks(Self::BAND)).zip(ends.chunks(Self::BAND))
        {
            let mut columns = [[u8::MAX; Self::BAND], [0; Self::BAND]];
            columns[0][..firsts.len()].copy_from_slice(firsts);
            columns[1][..ends.len()].copy_from_slice(ends);
            let [firsts, ends] = columns;
            let bits = nonzero_bytes(ends);
            if bits != 0 {
                let first = firsts.iter().fold(u8::MAX, |all, first| all.min(*first));
                let end = ends.iter().fold(0, |all, end| all.max(*end));
                merge(band, [bits, first, end]);
            }
        }
    }
}

/// Adds dirty rows and their span to a band.
#[inline]
fn merge(band: &mut [u8; 3], [bits, first, end]: [u8; 3]) {
    let before = if band[0] == 0 { u8::MAX } else { band[1] };
    *band = [band[0] | bits, first.min(before), end.max(band[2])];
}

/// A bit for each byte that is not 0.
#[inline]
fn nonzero_bytes(bytes: [u8; DirtyBands::BAND]) -> u8 {
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

    const SIDE: usize = 84;

    /// The rows and pixels of a frame's array that are dirty.
    fn named(dirty: &DirtyBands) -> Vec<(usize, usize)> {
        let bands = dirty.bands().iter().enumerate();
        let rows = bands.flat_map(|(band, &[rows, start, end])| {
            let named = (0..DirtyBands::BAND).filter(move |row| rows >> row & 1 != 0);
            named.map(move |row| (band * DirtyBands::BAND + row, start..end))
        });
        rows.flat_map(|(row, pixels)| pixels.map(move |pixel| (row, pixel.into()))).collect()
    }

    #[test]
    fn everything_and_nothing_are_dirty() {
        for row_major in [false, true] {
            let mut dirty = DirtyBands::new(row_major);
            dirty.mark(&(5..5), &(0..9));
            dirty.mark(&(5..6), &(9..9));
            dirty.mark_spans(&[u8::MAX; SIDE], &[0; SIDE]);
            assert_eq!(dirty.bands, [[0; 3]; 16]);
            let mut spans = dirty.clone();
            dirty.mark(&(0..SIDE), &(0..SIDE));
            spans.mark_spans(&[0; SIDE], &[SIDE as u8; SIDE]);
            assert_eq!(named(&dirty).len(), SIDE * SIDE);
            assert_eq!(dirty.bands, spans.bands);
        }
    }

    proptest! {
        /// Every marked pixel is dirty; the dirty rows, and the ends of a band's span, have marked pixels.
        #[test]
        fn marked_pixels_are_dirty(
            rects in prop::collection::vec((0..SIDE, 1..20_usize, 0..SIDE, 1..20_usize), 0..5),
            row_major: bool,
        ) {
            let mut dirty = DirtyBands::new(row_major);
            let mut spans = dirty.clone();
            let mut marked = Vec::new();
            for (x, width, y, height) in rects {
                let (columns, rows) = (x..(x + width).min(SIDE), y..(y + height).min(SIDE));
                dirty.mark(&columns, &rows);
                let (mut firsts, mut ends) = ([u8::MAX; SIDE], [0; SIDE]);
                firsts[columns.clone()].fill(rows.start as u8);
                ends[columns.clone()].fill(rows.end as u8);
                spans.mark_spans(&firsts, &ends);
                let pixels = columns.flat_map(|x| rows.clone().map(move |y| (x, y)));
                marked.extend(pixels.map(|(x, y)| if row_major { (y, x) } else { (x, y) }));
            }
            prop_assert_eq!(dirty.bands, spans.bands);
            let named = named(&dirty);
            prop_assert!(marked.iter().all(|pixel| named.contains(pixel)));
            for (row, pixel) in named {
                let band = marked.iter().filter(|marked| marked.0 / DirtyBands::BAND == row / DirtyBands::BAND);
                prop_assert!(marked.iter().any(|marked| marked.0 == row));
                prop_assert!(band.clone().any(|marked| marked.1 <= pixel) && band.clone().any(|marked| marked.1 >= pixel));
            }
        }
    }
}
