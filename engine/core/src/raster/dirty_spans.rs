//! Dirty tracking by columns: one span of rows for each.

use std::ops::Range;

/// For each column of a canvas, the smallest span that has all painted pixels.
#[derive(Clone, Debug)]
pub struct DirtySpans {
    /// The first dirty row of each column, if it has one.
    first: [u8; DirtySpans::COLUMNS],
    /// The row behind the last dirty one; 0 in a column without one.
    end: [u8; DirtySpans::COLUMNS],
}

impl DirtySpans {
    /// Maximum number of columns.
    pub const COLUMNS: usize = 128;

    /// No dirty pixel.
    #[inline]
    pub fn new() -> Self {
        DirtySpans { first: [u8::MAX; Self::COLUMNS], end: [0; Self::COLUMNS] }
    }

    /// Marks some rows of some columns.
    #[inline]
    pub(super) fn mark_rows(&mut self, columns: Range<usize>, rows: &Range<usize>) {
        if rows.start < rows.end {
            let (start, end) = (rows.start as u8, rows.end as u8);
            self.first[columns.clone()].iter_mut().for_each(|first| *first = start.min(*first));
            self.end[columns].iter_mut().for_each(|behind| *behind = end.max(*behind));
        }
    }

    /// For consecutive bands of `N` columns: the first dirty row of each column, which is more than any row if there is none, and the
    /// one behind the last, which is 0.
    #[inline]
    pub fn bands<const N: usize>(&self) -> impl Iterator<Item = (&[u8; N], &[u8; N])> {
        self.first.as_chunks().0.iter().zip(self.end.as_chunks().0)
    }
}

impl Default for DirtySpans {
    fn default() -> Self {
        DirtySpans::new()
    }
}
