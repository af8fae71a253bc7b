//! The frames that come through the service, whoever holds which of them for how long, and whoever dies.
//!
//! The engines check what they draw; what arrives is compared with what a pool of our own draws in full.

mod service_support;

use std::time::Duration;

use endless_gym::batch::{Batch, zeroed};
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Threads};
use endless_gym::service::{BatchLease, Observer, Trainer};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use service_support::{ID, Place, play_role};

const SECONDS: Duration = Duration::from_secs(5);
const NUM_ENVS: usize = 4;

#[test]
#[ignore = "a child process of the other tests"]
fn role() {
    play_role();
}

/// Batches that somebody holds, with what was in them when they came.
#[derive(Default)]
struct Held(Vec<(BatchLease, Vec<u8>)>);

impl Held {
    fn keep(&mut self, received: BatchLease) {
        let frames = received.batch().observation().to_vec();
        self.0.push((received, frames));
    }

    /// Gives some back, and any that are one too many.
    fn release(&mut self, random: &mut SmallRng) {
        for (received, frames) in &self.0 {
            assert!(received.batch().observation() == frames, "a held batch changed");
        }
        while self.0.len() > 2 || (!self.0.is_empty() && random.random_bool(0.4)) {
            self.0.swap_remove(random.random_range(0..self.0.len()));
        }
    }
}

/// Plays beside a pool that draws everything in full, while two observers watch now and then.
fn play(trainer: &mut Trainer, observers: &mut [Observer], steps: u64, random: &mut SmallRng) {
    let mut pool = Pool::new(&PoolConfig::new(ID, NUM_ENVS), &Threads::new(1).unwrap()).unwrap();
    let mut held: Vec<Held> = (0..=observers.len()).map(|_| Held::default()).collect();
    let seed = random.random_range(0..1000);
    trainer.reset(0, ResetRequest::Seed(seed)).unwrap();
    // Memory that nobody has written into is drawn in full.
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
fn frames_are_right_whoever_holds_them_and_whoever_is_restarted() {
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
            // The trainer goes, and its successor finds what it left behind.
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
