//! Which items of a call each thread has left.
//!
//! Each thread starts with the same share in every step, so that an environment's memory mostly stays in the cache of one core.
//! It takes smaller and smaller pieces from the share's start; when it has none left, it takes pieces from the ends of the others.
//!
//! A step of 1,024 environments on 16 threads lasts some 20 µs, and moving a cache line between two cores up to half of one. So a
//! share is one word on a cache line of its own, which usually only its thread writes, and nobody prepares the shares: a word of
//! an earlier division stands for a share from which nothing has been taken.

use std::ops::Range;

use crossbeam_utils::CachePadded;

use crate::batch::limits::MAX_ENVS;
use crate::pool::sync::threads::{AtomicU64, Ordering};

/// Bits of a word for the first item that is left, and for the end of the items.
const BITS: u32 = (2 * MAX_ENVS).ilog2();

/// Divisions that a word can tell apart.
const DIVISIONS: u64 = 1 << (64 - 2 * BITS);

/// A piece is this fraction of what is left of a share, so that threads finish at about the same time.
const PART_OF_REST: usize = 4;

/// Fewest items of a piece, which cost about as much as taking it from another thread.
const LEAST: usize = 4;

/// Most items of a piece.
const MOST: usize = 32;

/// The shares of all threads.
#[derive(Debug)]
pub(super) struct Shares {
    /// By thread: number of the division, first item left, end of the items.
    left: Vec<CachePadded<AtomicU64>>,
    /// Number of the last division.
    division: u64,
}

impl Shares {
    /// Shares for up to `threads` threads.
    pub(super) fn new(threads: usize) -> Self {
        Shares { left: (0..threads).map(|_| CachePadded::default()).collect(), division: 0 }
    }

    /// Divides `0..items` into `count` shares.
    ///
    /// # Panics
    ///
    /// If there are more than [`MAX_ENVS`] items.
    pub(super) fn divide(&mut self, items: usize, count: usize) -> Division<'_> {
        assert!(items <= MAX_ENVS, "{items} items");
        self.division = (self.division + 1) % DIVISIONS;
        if self.division == 0 {
            // The numbers start again, so no word may keep one.
            self.left.iter().for_each(|word| word.store(0, Ordering::Relaxed));
            self.division = 1;
        }
        Division { left: &self.left[..count], division: self.division, items }
    }
}

/// A division, from which threads take pieces.
#[derive(Clone, Copy)]
pub(super) struct Division<'a> {
    left: &'a [CachePadded<AtomicU64>],
    division: u64,
    items: usize,
}

impl Division<'_> {
    /// Calls `work` with pieces until none is left.
    pub(super) fn for_each_piece(&self, thread: usize, work: &(dyn Fn(Range<usize>) + Sync)) {
        let count = self.left.len();
        for share in (thread..count).chain(0..thread) {
            while let Some(piece) = self.take(share, share == thread) {
                work(piece);
            }
        }
    }

    /// Takes a piece from the start or the end of a share. The words need no memory order: the handshake of a call orders the
    /// items' memory between the threads of different calls.
    fn take(&self, share: usize, from_start: bool) -> Option<Range<usize>> {
        let mut word = self.left[share].load(Ordering::Relaxed);
        loop {
            let left = self.unpack(word, share);
            if left.is_empty() {
                return None;
            }
            let piece = (left.len() / PART_OF_REST).clamp(LEAST, MOST).min(left.len());
            let middle = if from_start { left.start + piece } else { left.end - piece };
            let (mut taken, mut rest) = (left.start..middle, middle..left.end);
            if !from_start {
                (taken, rest) = (rest, taken);
            }
            let new = (self.division << (2 * BITS)) | ((rest.start as u64) << BITS) | rest.end as u64;
            match self.left[share].compare_exchange_weak(word, new, Ordering::Relaxed, Ordering::Relaxed) {
                Ok(_) => return Some(taken),
                Err(changed) => word = changed,
            }
        }
    }

    /// The items that a word of this share stands for.
    fn unpack(&self, word: u64, share: usize) -> Range<usize> {
        if word >> (2 * BITS) == self.division {
            let number = |shift: u32| (word >> shift) as usize & ((1 << BITS) - 1);
            number(BITS)..number(0)
        } else {
            let count = self.left.len();
            self.items * share / count..self.items * (share + 1) / count
        }
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use std::sync::Mutex;

    use super::*;

    /// Takes all pieces in turns of the threads, and asserts that each item was taken once.
    fn check(division: Division<'_>) {
        let taken = Mutex::new(vec![0; division.items]);
        std::thread::scope(|scope| {
            for thread in 0..division.left.len() {
                let taken = &taken;
                scope.spawn(move || {
                    division.for_each_piece(thread, &|piece| {
                        std::thread::yield_now();
                        taken.lock().unwrap()[piece].iter_mut().for_each(|times| *times += 1);
                    });
                });
            }
        });
        assert!(taken.into_inner().unwrap().iter().all(|times| *times == 1));
    }

    #[test]
    fn every_item_is_taken_once_in_every_division() {
        let mut shares = Shares::new(5);
        for (items, count) in [(64, 2), (1024, 5), (1, 3), (1000, 3), (0, 2), (63, 5), (MAX_ENVS, 2), (64, 1)] {
            check(shares.divide(items, count));
        }
    }

    /// Words of earlier divisions are still there when the numbers start again.
    #[test]
    fn numbers_of_divisions_start_again() {
        let mut shares = Shares::new(3);
        for _ in 0..3 {
            check(shares.divide(100, 3));
            shares.division = DIVISIONS - 2;
            check(shares.divide(50, 2));
        }
    }
}
