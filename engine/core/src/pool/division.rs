//! Divides a batch among threads.

use std::sync::PoisonError;

use super::drawn_scene::DrawnScene;
use super::env_slot::EnvSlot;
use super::error::PoolError;
use super::sync::{Mutex, lock};
use super::threads::{Threads, useful_threads};
use crate::batch::BatchMut;
use crate::disjoint::DisjointSlice;
use crate::envs::Environment;

/// The number of an environment, and its error.
pub(super) type OfEnv = (usize, PoolError);

/// Consecutive environments, with their drawn scenes and their rows of the batch.
pub(super) struct EnvRange<'a, E: Environment> {
    /// Number of the first environment.
    pub first: usize,
    pub slots: DisjointSlice<'a, EnvSlot<E>>,
    /// One scene for each frame of each environment's observation.
    pub drawn: DisjointSlice<'a, DrawnScene<E>>,
    /// Frames in an observation.
    pub stack: usize,
    pub out: BatchMut<'a>,
}

impl<E: Environment> EnvRange<'_, E> {
    /// Calls `work` with all `num_envs` environments, piece by piece, in the calling thread and in the workers that join. Returns
    /// the error of the environment with the lowest number.
    pub fn for_each_piece(
        self,
        num_envs: usize,
        threads: &Threads,
        work: impl Fn(EnvRange<'_, E>) -> Result<(), OfEnv> + Sync,
    ) -> Result<(), OfEnv> {
        let count = threads.count().min(useful_threads(num_envs));
        if count < 2 {
            return work(self);
        }
        let outcome = Mutex::new(Ok(()));
        threads.for_each_piece(num_envs, count, &|envs| {
            let stack = self.stack;
            // SAFETY: `Threads::for_each_piece` calls this once for each environment, so no two parts share one.
            let piece = unsafe {
                EnvRange {
                    first: self.first + envs.start,
                    slots: self.slots.part(envs.clone()),
                    drawn: self.drawn.part(envs.start * stack..envs.end * stack),
                    stack,
                    out: self.out.part(envs),
                }
            };
            let Err(failed) = work(piece) else { return };
            let mut outcome = lock(&outcome);
            if outcome.as_ref().err().is_none_or(|known: &OfEnv| failed.0 < known.0) {
                *outcome = Err(failed);
            }
        });
        outcome.into_inner().unwrap_or_else(PoisonError::into_inner)
    }
}
