//! A mutable slice of which several threads take disjoint parts.

use std::marker::PhantomData;
use std::ops::Range;

/// A `&mut [T]` that can be taken apart through a shared reference.
#[derive(Debug)]
pub(crate) struct DisjointSlice<'a, T> {
    start: *mut T,
    length: usize,
    slice: PhantomData<&'a mut [T]>,
}

// SAFETY: it stands for a `&mut [T]`.
unsafe impl<T: Send> Send for DisjointSlice<'_, T> {}
// SAFETY: a shared reference gives access only through `part`, whose callers make sure that no element has two users.
unsafe impl<T: Send> Sync for DisjointSlice<'_, T> {}

impl<'a, T> DisjointSlice<'a, T> {
    /// The whole slice.
    pub fn new(slice: &'a mut [T]) -> Self {
        DisjointSlice { start: slice.as_mut_ptr(), length: slice.len(), slice: PhantomData }
    }

    /// The elements.
    pub fn as_mut(&mut self) -> &mut [T] {
        // SAFETY: the elements are those of a mutable slice, or of a part of one that nobody else uses.
        unsafe { std::slice::from_raw_parts_mut(self.start, self.length) }
    }

    /// The elements in `range`.
    ///
    /// # Panics
    ///
    /// If they are out of range.
    ///
    /// # Safety
    ///
    /// While the part exists, no other part contains any of its elements.
    pub unsafe fn part(&self, range: Range<usize>) -> DisjointSlice<'_, T> {
        assert!(range.start <= range.end && range.end <= self.length, "{range:?} of {}", self.length);
        DisjointSlice {
            // SAFETY: within the slice, by the assertion.
            start: unsafe { self.start.add(range.start) },
            length: range.len(),
            slice: PhantomData,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_those_of_the_slice() {
        let mut numbers = [0; 10];
        let whole = DisjointSlice::new(&mut numbers);
        // SAFETY: the parts have no element in common.
        let (mut left, mut right) = unsafe { (whole.part(0..4), whole.part(7..10)) };
        std::thread::scope(|scope| {
            scope.spawn(|| left.as_mut().fill(1));
            right.as_mut().fill(2);
        });
        assert_eq!(numbers, [1, 1, 1, 1, 0, 0, 0, 2, 2, 2]);
    }

    #[test]
    #[should_panic(expected = "3..5 of 4")]
    fn parts_beyond_the_slice_are_refused() {
        let mut numbers = [0; 4];
        let whole = DisjointSlice::new(&mut numbers);
        // SAFETY: it is the only part.
        unsafe { whole.part(3..5) };
    }
}
