//! The division of a batch among threads.

use std::ops::RangeInclusive;
use std::sync::{OnceLock, PoisonError};

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
        self.for_each_piece_on(threads, count, work)
    }

    /// As [`for_each_piece`](Self::for_each_piece) with `count` threads. The shares take kilobytes of the stack.
    #[inline(never)]
    fn for_each_piece_on(
        self,
        threads: &Threads,
        count: usize,
        work: impl Fn(EnvRange<'_, E>) -> Result<(), WrongFrame> + Sync,
    ) -> Result<(), WrongFrame> {
        let shares = Shares::new(self, count);
        let outcome = Mutex::new(Ok(()));
        threads.run(count - 1, &|thread| {
            // A share is not refilled, so each is left once it is empty.
            let mut passed = 0;
            while passed < count {
                let Some(piece) = shares.take((thread + passed) % count, passed == 0) else {
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

/// Shares that are divided together. While the caller divides, no other thread can work, so it only divides the range into groups
/// of shares. Who first needs a share of a group divides the group.
const SHARES_IN_GROUP: usize = if cfg!(loom) { 2 } else { 8 };

/// Groups that need no allocation. The threads of loom's models have small stacks.
const GROUPS_ON_STACK: usize = if cfg!(loom) { 1 } else { 8 };

/// The shares of all threads.
struct Shares<'a, E: Environment> {
    groups: SmallVec<[Group<'a, E>; GROUPS_ON_STACK]>,
    is_empty: EmptyShares,
    num_envs: usize,
    /// Environments to take at a time.
    piece: usize,
}

/// Several shares.
struct Group<'a, E: Environment> {
    /// Empty until the group is divided, and only set under the lock of `undivided`. The last group may have fewer shares.
    shares: OnceLock<[Share<'a, E>; SHARES_IN_GROUP]>,
    /// Whether `shares` is set. Together with `undivided` in place of [`OnceLock::get_or_init`], which loom does not know: one of
    /// its threads would block all of them there.
    is_divided: AtomicBool,
    undivided: Mutex<Option<EnvRange<'a, E>>>,
}

/// What is left of the environments that one thread starts with, `None` if nothing is; on cache lines of its own.
#[repr(align(128))]
struct Share<'a, E: Environment>(Mutex<Option<EnvRange<'a, E>>>);

/// For each share, whether nothing is left of it. Read before a lock is taken, so that threads at the end of a step do not wait for
/// each other. They lie side by side: a thread without work reads one cache line or two, instead of one of each share.
#[repr(align(128))]
struct EmptyShares(SmallVec<[AtomicBool; SHARES_IN_GROUP * GROUPS_ON_STACK]>);

impl<'a, E: Environment> Shares<'a, E> {
    /// Divides a range into `count` shares, each of at least one environment.
    fn new(range: EnvRange<'a, E>, count: usize) -> Self {
        let num_envs = range.slots.len();
        let mut shares = Shares {
            groups: SmallVec::with_capacity(count.div_ceil(SHARES_IN_GROUP)),
            is_empty: EmptyShares((0..count).map(|_| AtomicBool::new(false)).collect()),
            num_envs,
            piece: (num_envs / count / PIECES_OF_SHARE).clamp(*ENVS_IN_PIECE.start(), *ENVS_IN_PIECE.end()),
        };
        let mut rest = range;
        for end in (SHARES_IN_GROUP..count).step_by(SHARES_IN_GROUP) {
            let (group, others) = rest.split_at(shares.start(end) - shares.start(end - SHARES_IN_GROUP));
            shares.groups.push(Group::new(group));
            rest = others;
        }
        shares.groups.push(Group::new(rest));
        shares
    }

    /// Number of shares.
    fn count(&self) -> usize {
        self.is_empty.0.len()
    }

    /// Number of the first environment of a share, counted from the first of the range.
    fn start(&self, share: usize) -> usize {
        self.num_envs * share / self.count()
    }

    /// Takes the first or the last piece of a share.
    fn take(&self, number: usize, from_front: bool) -> Option<EnvRange<'a, E>> {
        let is_empty = &self.is_empty.0[number];
        if is_empty.load(Ordering::Relaxed) {
            return None;
        }
        let group = &self.groups[number / SHARES_IN_GROUP];
        self.divide(group, number / SHARES_IN_GROUP * SHARES_IN_GROUP);
        let mut rest = lock(&group.shares.get()?[number % SHARES_IN_GROUP].0);
        let range = rest.take()?;
        let num_envs = range.slots.len();
        if num_envs <= self.piece {
            is_empty.store(true, Ordering::Relaxed);
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

    /// Makes the shares of a group, of which `first` is the first, unless that has been done. Other threads that need them wait for it.
    fn divide(&self, group: &Group<'a, E>, first: usize) {
        if group.is_divided.load(Ordering::Acquire) {
            return;
        }
        let mut undivided = lock(&group.undivided);
        let mut rest = undivided.take();
        if rest.is_none() {
            return;
        }
        _ = group.shares.set(std::array::from_fn(|number| {
            let share = first + number;
            let envs = rest.take().filter(|_| share < self.count()).map(|range| {
                let (envs, others) = range.split_at(self.start(share + 1) - self.start(share));
                rest = Some(others);
                envs
            });
            Share(Mutex::new(envs))
        }));
        group.is_divided.store(true, Ordering::Release);
    }
}

impl<'a, E: Environment> Group<'a, E> {
    fn new(range: EnvRange<'a, E>) -> Self {
        Group { shares: OnceLock::new(), is_divided: AtomicBool::new(false), undivided: Mutex::new(Some(range)) }
    }
}
