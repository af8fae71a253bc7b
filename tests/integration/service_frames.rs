//! Frames received through the service, while batches are held for random times and processes are killed.
//!
//! The engines check their incremental drawing; the received frames are compared with those of a pool that draws in full.

use std::time::Duration;

use crate::support::service::{ID, Place};
use endless_gym::batch::{Batch, zeroed};
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Threads};
use endless_gym::service::{BatchLease, Observer, Trainer};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

const SECONDS: Duration = Duration::from_secs(5);
const NUM_ENVS: usize = 4;

/// Batches that are held, with a copy of their frames from when they were received.
#[derive(Default)]
struct Held(Vec<(BatchLease, Vec<u8>)>);

impl Held {
    fn keep(&mut self, received: BatchLease) {
        let frames = received.batch().observation().to_vec();
        self.0.push((received, frames));
    }

    /// Checks all batches and drops some at random, so that at most two are left.
    fn release(&mut self, random: &mut SmallRng) {
        for (received, frames) in &self.0 {
            assert!(received.batch().observation() == frames, "a held batch changed");
        }
        while self.0.len() > 2 || (!self.0.is_empty() && random.random_bool(0.4)) {
            self.0.swap_remove(random.random_range(0..self.0.len()));
        }
    }
}

/// Steps the engine and a pool that draws in full, and compares the frames. Observers receive batches at random.
fn play(trainer: &mut Trainer, observers: &mut [Observer], steps: u64, random: &mut SmallRng) {
    let mut pool = Pool::new(&PoolConfig::new(ID, NUM_ENVS), &Threads::new(1).unwrap()).unwrap();
    let mut held: Vec<Held> = (0..=observers.len()).map(|_| Held::default()).collect();
    let seed = random.random_range(0..1000);
    trainer.reset(0, ResetRequest::Seed(seed)).unwrap();
    // A new buffer is drawn in full.
    let mut expected = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::Seed(seed), &mut expected).unwrap();
    for step in 0..=steps {
        let received = trainer.receive(0, SECONDS).unwrap();
        let frames = Batch::new(pool.layout(), &expected).observation();
        assert!(received.batch().observation() == frames, "step {step}");
        held[0].keep(received);
        for (observer, held) in observers.iter_mut().zip(&mut held[1..]) {
            if random.random_bool(0.5) {
                held.0.truncate(2);
                if let Some(seen) = observer.newest().unwrap() {
                    held.keep(seen);
                }
            }
        }
        held.iter_mut().for_each(|held| held.release(random));
        let mut actions = vec![0; trainer.specification().action_space.branches().len() * NUM_ENVS];
        actions.fill_with(|| random.random_range(0..4));
        expected = zeroed(pool.layout().blocks());
        pool.step(&actions, &mut expected).unwrap();
        trainer.send(0, &actions).unwrap();
    }
    trainer.receive(0, SECONDS).unwrap();
}

#[test]
fn frames_are_correct_while_batches_are_held_and_processes_restart() {
    let place = Place::new();
    let mut random = SmallRng::seed_from_u64(2);
    let mut engine = place.engine("gym", NUM_ENVS, 1);
    let mut trainer = place.trainer("gym").unwrap();
    for round in 0..6 {
        let config = place.connect_config("gym");
        let mut observers = [Observer::connect(&config, 0).unwrap(), Observer::connect(&config, 0).unwrap()];
        play(&mut trainer, &mut observers, 150, &mut random);
        drop(observers);
        if round % 2 == 0 {
            // The next trainer receives chunks that the last one returned.
            drop(trainer);
            trainer = place.trainer("gym").unwrap();
        } else {
            engine.kill();
            engine = place.engine("gym", NUM_ENVS, 1);
            drop(trainer);
            trainer = place.trainer("gym").unwrap();
        }
    }
    drop(trainer);
    engine.end();
}
