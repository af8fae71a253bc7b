//! Batches of sequences of the same length.

use std::ops::Range;
use std::slice::{ChunksExact, ChunksExactMut};

use crate::matrix::Packed;

/// S sequences of T steps each in time-major order: row t * S + s is step t of sequence s.
///
/// Shapes are given with M = T * S, the number of steps of all sequences.
#[derive(Clone, Copy)]
pub struct Sequences<'a> {
    count: usize,
    resets: &'a [bool],
}

impl<'a> Sequences<'a> {
    /// So many sequences, S, with as many steps as `resets` (M,) has rows.
    ///
    /// `resets` marks steps at which an episode starts: the state before such a step is 0, and no gradient passes it.
    /// Fails with what is wrong if the number of resets is not a multiple of the number of sequences.
    pub fn new(count: usize, resets: &'a [bool]) -> Result<Self, String> {
        if !resets.len().is_multiple_of(count) {
            let given = resets.len();
            return Err(format!("the number of resets must be a multiple of the {count} sequences, got {given}"));
        }
        Ok(Sequences { count, resets })
    }

    /// S, the number of sequences.
    pub fn count(&self) -> usize {
        self.count
    }

    /// M, the number of steps of all sequences.
    pub fn rows(&self) -> usize {
        self.resets.len()
    }

    /// The steps, from the first to the last.
    pub(crate) fn steps(self) -> impl DoubleEndedIterator<Item = Step<'a>> {
        let count = self.count.max(1);
        let steps = self.resets.chunks_exact(count).enumerate();
        steps.map(move |(t, resets)| Step { rows: t * count..(t + 1) * count, resets })
    }
}

/// A step of all sequences.
pub(crate) struct Step<'a> {
    /// Its rows, one for each sequence.
    rows: Range<usize>,
    resets: &'a [bool],
}

impl Step<'_> {
    /// The part of this step (S, width) of a matrix (M, width).
    pub fn of<'m>(&self, matrix: &'m [f32], width: usize) -> &'m [f32] {
        &matrix[self.rows.start * width..self.rows.end * width]
    }

    /// The rows of this step in a matrix (M, width).
    pub fn rows<'m>(&self, matrix: &'m [f32], width: usize) -> ChunksExact<'m, f32> {
        self.of(matrix, width).chunks_exact(width)
    }

    /// As [`rows`](Self::rows), to write to.
    pub fn rows_mut<'m>(&self, matrix: &'m mut [f32], width: usize) -> ChunksExactMut<'m, f32> {
        matrix[self.rows.start * width..self.rows.end * width].chunks_exact_mut(width)
    }

    /// Copies the states before this step to columns of `saved` (M, `saved_width`): from `outputs` (M, H), from `state` (S, H) at the first
    /// step, or 0 where an episode starts.
    pub fn copy_states_before(
        &self,
        state: &[f32],
        outputs: &[f32],
        saved: &mut [f32],
        saved_width: usize,
        columns: Range<usize>,
    ) {
        let width = columns.len();
        let before = match self.rows.start.checked_sub(self.rows.len()) {
            Some(start) => &outputs[start * width..self.rows.start * width],
            None => state,
        };
        let rows = self.rows_mut(saved, saved_width).zip(before.chunks_exact(width));
        for ((saved, before), is_reset) in rows.zip(self.resets) {
            let saved = &mut saved[columns.clone()];
            if *is_reset {
                saved.fill(0.0);
            } else {
                saved.copy_from_slice(before);
            }
        }
    }

    /// Stops the gradients (S, width) of the states before this step where an episode starts.
    pub fn stop_at_resets(&self, gradients: &mut [f32], width: usize) {
        for (gradient, is_reset) in gradients.chunks_exact_mut(width).zip(self.resets) {
            if *is_reset {
                gradient.fill(0.0);
            }
        }
    }
}

/// Memory that calls of a layer reuse.
#[derive(Default)]
pub struct Workspace {
    pub(crate) packed: Packed,
    pub(crate) rows: Vec<f32>,
}

/// The parts of equal width of a row.
#[inline(always)]
pub(crate) fn parts<const N: usize>(row: &[f32], width: usize) -> [&[f32]; N] {
    std::array::from_fn(|part| &row[part * width..][..width])
}

/// The parts of equal width of a row, to write to.
#[inline(always)]
pub(crate) fn parts_mut<const N: usize>(row: &mut [f32], width: usize) -> [&mut [f32]; N] {
    let mut parts = row.chunks_exact_mut(width);
    std::array::from_fn(|_| parts.next().expect("a row has all its parts"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_name_the_sequences_and_the_resets() {
        let message = |count: usize| Sequences::new(count, &[false; 3]).err();
        assert_eq!(message(3), None);
        assert_eq!(message(2).unwrap(), "the number of resets must be a multiple of the 2 sequences, got 3");
        assert_eq!(message(0).unwrap(), "the number of resets must be a multiple of the 0 sequences, got 3");
    }
}
