//! The order of steps in a batch of sequences.

use std::ops::Range;

/// Sequences in time-major order: first step 0 of all sequences, then step 1 of the sequences that have one, and so on. Longer
/// sequences come first. This is the order of PyTorch's `PackedSequence`; there is no padding.
///
/// Shapes are given with M, the number of steps of all sequences, and S, the number of sequences.
#[derive(Clone, Copy)]
pub struct Sequences<'a> {
    sizes: &'a [usize],
    resets: &'a [bool],
}

impl<'a> Sequences<'a> {
    /// Sequences of which `sizes[t]` have a step `t`.
    ///
    /// `resets` (M,) marks steps at which an episode starts: the state before such a step is 0, and no gradient passes it. If it is
    /// empty, there are none.
    ///
    /// # Errors
    ///
    /// Says what is wrong if a size is 0 or larger than the one before, or if there is not one reset for each step.
    pub fn new(sizes: &'a [usize], resets: &'a [bool]) -> Result<Self, String> {
        if let Some(t) = (0..sizes.len()).find(|&t| sizes[t] == 0 || (t > 0 && sizes[t] > sizes[t - 1])) {
            return Err(format!("the sizes must not increase, and be 1 or more; got {} at step {t}", sizes[t]));
        }
        let steps: usize = sizes.iter().sum();
        if !resets.is_empty() && resets.len() != steps {
            return Err(format!("there must be one reset for each of {steps} steps or none, got {}", resets.len()));
        }
        Ok(Sequences { sizes, resets })
    }

    /// S, the number of sequences.
    pub fn count(&self) -> usize {
        self.sizes.first().copied().unwrap_or(0)
    }

    /// M, the number of steps of all sequences.
    pub fn steps(&self) -> usize {
        self.sizes.iter().sum()
    }

    /// The steps of the longest sequence, from the first to the last.
    pub(crate) fn forward(self) -> impl Iterator<Item = Step<'a>> {
        let starts = self.sizes.iter().scan(0..0, |rows, size| {
            *rows = rows.end..rows.end + size;
            Some(rows.clone())
        });
        starts.scan(0, move |previous, rows| {
            let first = std::mem::replace(previous, rows.start);
            Some(Step { rows, previous: first, resets: self.resets })
        })
    }

    /// The steps of the longest sequence, from the last to the first.
    pub(crate) fn backward(self) -> impl Iterator<Item = Step<'a>> {
        let mut start = self.steps();
        (0..self.sizes.len()).rev().map(move |t| {
            let rows = start - self.sizes[t]..start;
            start = rows.start;
            let previous = if t == 0 { 0 } else { start - self.sizes[t - 1] };
            Step { rows, previous, resets: self.resets }
        })
    }
}

/// A step of all sequences that have it.
pub(crate) struct Step<'a> {
    /// Its rows, one for each sequence.
    pub rows: Range<usize>,
    /// The first row of the step before.
    previous: usize,
    resets: &'a [bool],
}

impl Step<'_> {
    fn is_reset(&self, row: usize) -> bool {
        self.resets.get(row).is_some_and(|reset| *reset)
    }

    /// Copies the state before a row: from `outputs` (M, width), from `state` (S, width) at the first step, or 0 where an episode
    /// starts.
    pub fn copy_state_before(&self, row: usize, state: &[f32], outputs: &[f32], to: &mut [f32]) {
        let (width, sequence) = (to.len(), row - self.rows.start);
        if self.is_reset(row) {
            to.fill(0.0);
        } else if self.rows.start == 0 {
            to.copy_from_slice(&state[sequence * width..][..width]);
        } else {
            to.copy_from_slice(&outputs[(self.previous + sequence) * width..][..width]);
        }
    }

    /// Stops the gradients (S, width) of the states before this step where an episode starts.
    pub fn stop_at_resets(&self, gradients: &mut [f32], width: usize) {
        for (row, gradient) in self.rows.clone().zip(gradients.chunks_exact_mut(width)) {
            if self.is_reset(row) {
                gradient.fill(0.0);
            }
        }
    }
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
    fn steps_forward_and_backward_have_the_same_rows() {
        let sequences = Sequences::new(&[3, 3, 1], &[]).unwrap();
        let forward: Vec<_> = sequences.forward().map(|step| (step.rows, step.previous)).collect();
        assert_eq!(forward, [(0..3, 0), (3..6, 0), (6..7, 3)]);
        let mut backward: Vec<_> = sequences.backward().map(|step| (step.rows, step.previous)).collect();
        backward.reverse();
        assert_eq!(forward, backward);
        assert_eq!((sequences.count(), sequences.steps()), (3, 7));
    }

    #[test]
    fn errors_name_the_size_or_the_number_of_resets() {
        let message = |sizes: &[usize], resets: &[bool]| Sequences::new(sizes, resets).err().unwrap();
        assert_eq!(message(&[2, 3], &[]), "the sizes must not increase, and be 1 or more; got 3 at step 1");
        assert_eq!(message(&[2, 0], &[]), "the sizes must not increase, and be 1 or more; got 0 at step 1");
        assert_eq!(message(&[2], &[true]), "there must be one reset for each of 2 steps or none, got 1");
    }
}
