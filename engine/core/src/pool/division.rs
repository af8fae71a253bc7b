//! Divides a batch among threads.

use std::ops::RangeInclusive;
use std::sync::PoisonError;

use smallvec::SmallVec;

use super::drawn_scene::{DrawnScene, WrongFrame};
use super::env_slot::EnvSlot;
use super::sync::{Mutex, lock};
use super::threads::Threads;
use crate::batch::BatchMut;
use crate::envs::Environment;

/// Environments that a thread takes at a time: few enough that threads finish at about the same time, and many enough that
/// taking them costs little.
const ENVS_IN_PIECE: RangeInclusive<usize> = 8..=16;

/// Pieces in a share, within the limits of [`ENVS_IN_PIECE`].
const PIECES_OF_SHARE: usize = 8;

/// Minimum number of environments per thread.
const ENVS_FOR_THREAD: usize = 16;

/// Minimum number of environments for using workers. The calling thread finishes fewer before a worker joins.
const ENVS_FOR_THREADS: usize = 64;

/// Number of shares that need no allocation.
const SHARES_ON_STACK: usize = 16;

/// Consecutive environments, with their drawn scenes and their rows of the batch.
pub(super) struct EnvRange<'a, E: Environment> {
    /// Number of the first environment.
    pub first: usize,
    pub slots: &'a mut [EnvSlot<E>],
    /// One scene for each frame of each environment's observation.
    pub drawn: &'a mut [DrawnScene<E>],
    /// Frames in an observation.
    pub stack: usize,
    pub out: BatchMut<'a>,
}

/// The remaining environments of one thread's share; `None` if none are left. Aligned to avoid false sharing.
#[repr(align(128))]
struct Share<'a, E: Environment>(Mutex<Option<EnvRange<'a, E>>>);

impl<'a, E: Environment> Share<'a, E> {
    /// Takes a piece from the start or the end of the share.
    fn take(&self, piece: usize, from_start: bool) -> Option<EnvRange<'a, E>> {
        let mut left = lock(&self.0);
        let range = left.take()?;
        let num_envs = range.slots.len();
        if num_envs <= piece {
            return Some(range);
        }
        let (taken, others) = if from_start {
            range.split_at(piece)
        } else {
            let (others, taken) = range.split_at(num_envs - piece);
            (taken, others)
        };
        *left = Some(others);
        Some(taken)
    }
}

impl<'a, E: Environment> EnvRange<'a, E> {
    /// Calls `work` with the whole range, piece by piece, in the calling thread and in the workers that join. Each thread
    /// starts with the same share in every step, so that an environment's memory mostly stays in the cache of one core. A
    /// thread that has finished its share takes pieces from the ends of the others. Returns the error of the environment with
    /// the lowest number.
    pub fn for_each_piece(
        self,
        threads: &Threads,
        work: impl Fn(EnvRange<'_, E>) -> Result<(), WrongFrame> + Sync,
    ) -> Result<(), WrongFrame> {
        let count = threads.count().min(self.slots.len() / ENVS_FOR_THREAD);
        if count < 2 || self.slots.len() < ENVS_FOR_THREADS {
            return work(self);
        }
        self.for_each_piece_on(threads, count, work)
    }

    /// Like [`for_each_piece`](Self::for_each_piece), with `count` threads. Not inlined, since the shares take kilobytes of
    /// stack.
    #[inline(never)]
    fn for_each_piece_on(
        self,
        threads: &Threads,
        count: usize,
        work: impl Fn(EnvRange<'_, E>) -> Result<(), WrongFrame> + Sync,
    ) -> Result<(), WrongFrame> {
        let piece = (self.slots.len() / count / PIECES_OF_SHARE).clamp(*ENVS_IN_PIECE.start(), *ENVS_IN_PIECE.end());
        let mut shares = SmallVec::<[Share<'_, E>; SHARES_ON_STACK]>::with_capacity(count);
        let mut rest = self;
        for left in (1..=count).rev() {
            let envs = rest.slots.len() / left;
            let (share, others) = rest.split_at(envs);
            shares.push(Share(Mutex::new(Some(share))));
            rest = others;
        }
        let outcome = Mutex::new(Ok(()));
        threads.run(count - 1, &|thread| {
            for passed in 0..count {
                while let Some(taken) = shares[(thread + passed) % count].take(piece, passed == 0) {
                    let Err(wrong) = work(taken) else { continue };
                    let mut outcome = lock(&outcome);
                    if outcome.as_ref().err().is_none_or(|known: &WrongFrame| wrong.env < known.env) {
                        *outcome = Err(wrong);
                    }
                }
            }
        });
        outcome.into_inner().unwrap_or_else(PoisonError::into_inner)
    }

    /// Splits the range into its first `middle` environments and the rest.
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
