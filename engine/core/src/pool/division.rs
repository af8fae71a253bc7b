//! The division of a batch among threads.

use std::sync::PoisonError;

use super::drawn_scene::{DrawnScene, WrongFrame};
use super::env_slot::EnvSlot;
use super::sync::{Mutex, lock};
use super::threads::Threads;
use crate::batch::BatchMut;
use crate::envs::Environment;

/// Environments that a thread takes at a time: few, so that threads finish at about the same time.
const ENVS_IN_PIECE: usize = 16;

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

impl<E: Environment> EnvRange<'_, E> {
    /// Calls `work` with all of the range, piece by piece, in the calling thread and in the workers that join. The caller takes
    /// pieces from the front and workers from the back, so that the memory of an environment mostly stays in the cache of the core
    /// that touched it last. Returns the error of the environment with the lowest number.
    pub fn for_each_piece(
        self,
        threads: &Threads,
        work: impl Fn(EnvRange<'_, E>) -> Result<(), WrongFrame> + Sync,
    ) -> Result<(), WrongFrame> {
        if threads.count() == 1 || self.slots.len() < ENVS_FOR_THREADS {
            return work(self);
        }
        let helpers = self.slots.len().div_ceil(ENVS_IN_PIECE) - 1;
        let rest = Mutex::new(Some(self));
        let outcome = Mutex::new(Ok(()));
        threads.run(helpers, &|thread| {
            while let Some(piece) = Self::take_piece(&rest, thread == 0) {
                let Err(wrong) = work(piece) else { continue };
                let mut outcome = lock(&outcome);
                if outcome.as_ref().err().is_none_or(|known: &WrongFrame| wrong.env < known.env) {
                    *outcome = Err(wrong);
                }
            }
        });
        outcome.into_inner().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a piece off the remaining environments.
    fn take_piece(rest: &Mutex<Option<Self>>, from_front: bool) -> Option<Self> {
        let mut rest = lock(rest);
        let (piece, others) = rest.take()?.piece(from_front);
        *rest = others;
        Some(piece)
    }

    /// The first or last [`ENVS_IN_PIECE`] environments, and the others if there are any.
    fn piece(self, from_front: bool) -> (Self, Option<Self>) {
        let num_envs = self.slots.len();
        if num_envs <= ENVS_IN_PIECE {
            return (self, None);
        }
        if from_front {
            let (piece, others) = self.split_at(ENVS_IN_PIECE);
            (piece, Some(others))
        } else {
            let (others, piece) = self.split_at(num_envs - ENVS_IN_PIECE);
            (piece, Some(others))
        }
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
