//! The division of a batch among threads.

use std::ops::RangeInclusive;
use std::sync::PoisonError;

use smallvec::SmallVec;

use super::drawn_scene::{DrawnScene, WrongFrame};
use super::env_slot::EnvSlot;
use super::sync::{AtomicBool, Mutex, Ordering, lock};
use super::threads::Threads;
use crate::batch::BatchMut;
use crate::envs::Environment;

/// Environments that a thread takes at a time: few, so that threads finish at about the same time, and enough that taking them does
/// not count.
const ENVS_IN_PIECE: RangeInclusive<usize> = 8..=16;

/// Pieces of a share that is small or large enough.
const PIECES_OF_SHARE: usize = 8;

/// Minimum number of environments for each thread.
const ENVS_FOR_THREAD: usize = 16;

/// Minimum number of environments for more than one thread. Fewer are finished before a worker has joined.
const ENVS_FOR_THREADS: usize = 64;

/// Consecutive environments, with their drawn scenes and their rows of the batch.
pub(super) struct EnvRange<'a, E: Environment> {
    /// Number of the first environment.
    pub first: usize,
    pub slots: &'a mut [EnvSlot<E>],
    /// For each environment, as many as there are frames in an observation.
    pub drawn: &'a mut [DrawnScene<E>],
    /// Frames in an observation.
    pub stack: usize,
    pub out: BatchMut<'a>,
}

impl<'a, E: Environment> EnvRange<'a, E> {
    /// Calls `work` with all of the range, piece by piece, in the calling thread and in the workers that join. Each thread starts with
    /// a share of its own, the same in every step, so that the memory of an environment mostly stays in the cache, and near the
    /// core, of the thread that touched it first. Then it takes what is left of the other shares, from their ends. Returns the error
    /// of the environment with the lowest number.
    pub fn for_each_piece(
        self,
        threads: &Threads,
        work: impl Fn(EnvRange<'_, E>) -> Result<(), WrongFrame> + Sync,
    ) -> Result<(), WrongFrame> {
        let count = threads.count().min(self.slots.len() / ENVS_FOR_THREAD);
        if count < 2 || self.slots.len() < ENVS_FOR_THREADS {
            return work(self);
        }
        let shares = self.shares(count);
        let outcome = Mutex::new(Ok(()));
        threads.run(count - 1, &|thread| {
            // A share is not refilled, so each is left once it is empty.
            let mut passed = 0;
            while passed < count {
                let Some(piece) = shares[(thread + passed) % count].take(passed == 0) else {
                    passed += 1;
                    continue;
                };
                let Err(wrong) = work(piece) else { continue };
                let mut outcome = lock(&outcome);
                if outcome.as_ref().err().is_none_or(|known: &WrongFrame| wrong.env < known.env) {
                    *outcome = Err(wrong);
                }
            }
        });
        outcome.into_inner().unwrap_or_else(PoisonError::into_inner)
    }

    /// Divides the range into `count` shares, each of at least one environment.
    fn shares(self, count: usize) -> Shares<'a, E> {
        let mut shares = Shares::with_capacity(count);
        let mut rest = self;
        for left in (1..count).rev() {
            let share = rest.slots.len() / (left + 1);
            let (first, others) = rest.split_at(share);
            shares.push(Share::new(first));
            rest = others;
        }
        shares.push(Share::new(rest));
        shares
    }

    /// Divides everything before environment `middle`.
    fn split_at(self, middle: usize) -> (Self, Self) {
        let (first, stack) = (self.first, self.stack);
        let (left_slots, right_slots) = self.slots.split_at_mut(middle);
        let (left_drawn, right_drawn) = self.drawn.split_at_mut(middle * stack);
        let (left_out, right_out) = self.out.split_at(middle);
        (
            EnvRange { first, slots: left_slots, drawn: left_drawn, stack, out: left_out },
            EnvRange { first: first + middle, slots: right_slots, drawn: right_drawn, stack, out: right_out },
        )
    }
}

/// Shares that need no allocation. The threads of loom's models have small stacks.
const SHARES_ON_STACK: usize = if cfg!(loom) { 2 } else { 64 };

/// The shares of all threads.
type Shares<'a, E> = SmallVec<[Share<'a, E>; SHARES_ON_STACK]>;

/// What is left of the environments that one thread starts with; on cache lines of its own.
#[repr(align(128))]
struct Share<'a, E: Environment> {
    /// Nothing is left. Read before the lock is taken, so that threads at the end of a step do not wait for each other.
    is_empty: AtomicBool,
    rest: Mutex<Option<EnvRange<'a, E>>>,
    /// Environments to take at a time.
    piece: usize,
}

impl<'a, E: Environment> Share<'a, E> {
    fn new(range: EnvRange<'a, E>) -> Self {
        let piece = (range.slots.len() / PIECES_OF_SHARE).clamp(*ENVS_IN_PIECE.start(), *ENVS_IN_PIECE.end());
        Share { is_empty: AtomicBool::new(false), rest: Mutex::new(Some(range)), piece }
    }

    /// Takes the first or the last piece.
    fn take(&self, from_front: bool) -> Option<EnvRange<'a, E>> {
        if self.is_empty.load(Ordering::Relaxed) {
            return None;
        }
        let mut rest = lock(&self.rest);
        let range = rest.take()?;
        let num_envs = range.slots.len();
        if num_envs <= self.piece {
            self.is_empty.store(true, Ordering::Relaxed);
            return Some(range);
        }
        let (piece, others) = if from_front {
            range.split_at(self.piece)
        } else {
            let (others, piece) = range.split_at(num_envs - self.piece);
            (piece, others)
        };
        *rest = Some(others);
        Some(piece)
    }
}
