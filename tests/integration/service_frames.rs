//! Tests frames received through the service while batches are held for random times and processes are killed.
//!
//! The engines check their incremental drawing; the received frames are compared with those of a pool that draws in full.

use crate::support::place::Place;
use crate::support::player::{Player, random_actions};
use crate::support::process::TIMEOUT;
use crate::support::service::ID;
use endless_gym::batch::zeroed;
use endless_gym::pool::{PoolConfig, ResetRequest};
use endless_gym::service::{BatchLease, Observer, Trainer};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

const NUM_ENVS: usize = 4;

/// Held batches, with copies of their frames made on receipt.
#[derive(Default)]
struct Held(Vec<(BatchLease, Vec<u8>)>);

impl Held {
    fn keep(&mut self, received: BatchLease) {
        let frames = received.batch().observation().to_vec();
        self.0.push((received, frames));
    }

    /// Checks all batches and drops random ones, so that at most two are left.
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
    let mut player = Player::new(&PoolConfig::new(ID, NUM_ENVS));
    let mut held: Vec<Held> = (0..=observers.len()).map(|_| Held::default()).collect();
    let seed = random.random_range(0..1000);
    trainer.reset(0, ResetRequest::Seed(seed)).unwrap();
    player.reset(ResetRequest::Seed(seed));
    for step in 0..=steps {
        let received = trainer.receive(0, TIMEOUT).unwrap();
        assert!(received.batch().observation() == player.batch().observation(), "step {step}");
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
        let actions = random_actions(player.pool.spec(), NUM_ENVS, random);
        // A new buffer is drawn in full.
        player.blocks = zeroed(player.blocks.len());
        player.step(&actions);
        trainer.send(0, &actions).unwrap();
    }
    trainer.receive(0, TIMEOUT).unwrap();
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
        if round % 2 == 1 {
            engine.kill();
            engine = place.engine("gym", NUM_ENVS, 1);
        }
        // The next trainer receives chunks that the previous one returned.
        drop(trainer);
        trainer = place.trainer("gym").unwrap();
    }
    drop(trainer);
    engine.end();
}
