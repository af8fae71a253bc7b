//! The worker threads under loom: every interleaving up to a number of preemptions, and every value that the memory model
//! allows an atomic load to return. `cargo xtask test --only loom` runs these models.
//!
//! loom reports a deadlock if a worker never wakes for a call, or does not exit after the threads are dropped. It reports a
//! causality violation if a worker's write is not visible when the call returns.

use loom::cell::UnsafeCell;
use loom::model::Builder;

use super::*;
use crate::batch::zeroed;
use crate::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};
use crate::toy::toys;

const ID: &str = "Toy-v0";

/// Pieces of work. An unsynchronised mutable access fails the model.
struct Pieces {
    left: Mutex<Vec<usize>>,
    done: Vec<UnsafeCell<usize>>,
}

// SAFETY: loom checks each access to the cells; a data race ends the model.
unsafe impl Sync for Pieces {}

impl Pieces {
    fn new(count: usize) -> Self {
        Pieces { left: Mutex::new((0..count).collect()), done: (0..count).map(|_| UnsafeCell::new(0)).collect() }
    }

    /// Does the pieces that no other thread has taken.
    fn work(&self) {
        while let Some(piece) = { lock(&self.left).pop() } {
            self.work_on(piece);
        }
    }

    fn work_on(&self, piece: usize) {
        // SAFETY: loom checks that no other access is possible at the same time.
        self.done[piece].with_mut(|times| unsafe { *times += 1 });
    }

    /// Asserts that each piece has been done once.
    fn check(&self) {
        for times in &self.done {
            // SAFETY: as above.
            assert_eq!(times.with(|times| unsafe { *times }), 1);
        }
    }
}

fn model(preemptions: usize, model: impl Fn() + Sync + Send + 'static) {
    let mut builder = Builder::new();
    builder.preemption_bound.get_or_insert(preemptions);
    builder.check(model);
}

#[test]
fn loom_every_piece_of_two_calls_is_done_once_and_seen_by_the_caller() {
    model(3, || {
        let workers = Workers::new(1, true, false).unwrap();
        for _ in 0..2 {
            // Freed after its call, so a worker that joined late would use freed memory.
            let pieces = Pieces::new(2);
            workers.run(1, &|_| pieces.work());
            pieces.check();
        }
    });
}

#[test]
fn loom_two_workers_share_the_pieces() {
    model(2, || {
        let workers = Workers::new(2, true, false).unwrap();
        let pieces = Pieces::new(2);
        workers.run(2, &|_| pieces.work());
        pieces.check();
    });
}

#[test]
fn loom_a_worker_beyond_the_helpers_does_not_join() {
    model(2, || {
        let workers = Workers::new(2, true, false).unwrap();
        let pieces = Pieces::new(2);
        workers.run(1, &|number| {
            assert!(number < 2);
            pieces.work();
        });
        pieces.check();
    });
}

#[test]
fn loom_two_callers_take_turns() {
    model(3, || {
        let workers = Arc::new(Workers::new(1, true, false).unwrap());
        let other = Arc::clone(&workers);
        let call = |workers: &Workers| {
            let pieces = Pieces::new(1);
            workers.run(1, &|_| pieces.work());
            pieces.check();
        };
        let thread = thread::spawn(move || call(&other));
        call(&workers);
        thread.join().unwrap();
    });
}

/// The caller waits for the worker, so a call that does not wake it is a deadlock.
#[test]
fn loom_a_call_wakes_a_parked_worker() {
    model(3, || {
        let workers = Workers::new(1, true, false).unwrap();
        let pieces = Pieces::new(2);
        workers.on_each(2, &|thread| pieces.work_on(thread));
        pieces.check();
    });
}

/// Both threads take pieces of both shares, in two divisions of different sizes.
#[test]
fn loom_every_item_of_a_division_is_in_one_piece() {
    model(3, || {
        let workers = Workers::new(1, true, false).unwrap();
        for items in [10, 9] {
            let pieces = Pieces::new(items);
            workers.for_each_piece(items, 2, &|items| items.for_each(|item| pieces.work_on(item)));
            pieces.check();
        }
    });
}

#[test]
fn loom_workers_end_without_a_call() {
    model(3, || drop(Workers::new(2, true, false).unwrap()));
}

/// Two threads write the same batch as the calling thread alone.
#[test]
fn loom_a_pool_steps_every_environment_once() {
    fn play(threads: &Threads) -> Vec<u8> {
        let config = PoolConfig::new(ID, 64).frames(None).seeding(Seeding::Continue { seed: Some(1) });
        let mut pool = Pool::new(toys(), &config, threads).unwrap();
        let mut blocks = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut blocks).unwrap();
        pool.step(&[1; 64], &mut blocks).unwrap();
        // Two pools have different stamps.
        pool.layout().forget_frames(&mut blocks);
        bytemuck::cast_slice(&blocks).to_vec()
    }
    let expected = play(&Threads::new(1).unwrap());
    model(1, move || assert!(play(&Threads::new(2).unwrap()) == expected));
}
