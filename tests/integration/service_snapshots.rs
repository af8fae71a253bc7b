//! Tests that snapshots through the service equal those of a pool in this process and can be restored in both.

use std::time::Duration;

use crate::support::foreign::{Foreign, RequestHeader};
use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::TIMEOUT;
use crate::support::service::{ID, assert_error, assert_rejected, reset};
use endless_gym::memory_gym;
use endless_gym::pool::{EnvReset, PoolConfig, ResetOptions, ResetRequest};
use endless_gym::service::{Engine, EngineConfig, Rejection, ServiceError, Trainer};
use endless_gym_core::batch::SNAPSHOT_BYTES;

const NUM_ENVS: usize = 3;

/// Actions that differ from step to step and between environments.
fn actions(trainer: &Trainer, step: usize) -> Vec<i32> {
    let branches = trainer.specification().action_space.branches();
    (0..NUM_ENVS).flat_map(|env| branches.iter().map(move |n| ((step * 7 + env * 3) % *n as usize) as i32)).collect()
}

/// Steps an engine's environments and those of a pool, and compares the batches.
fn play_both(trainer: &mut Trainer, pool: &mut Player, steps: std::ops::Range<usize>) {
    for step in steps {
        let actions = actions(trainer, step);
        trainer.send(0, &actions).unwrap();
        let received = trainer.receive(0, TIMEOUT).unwrap();
        pool.step(&actions);
        assert!(received.batch().bytes() == pool.bytes(), "step {step}");
    }
}

#[test]
fn restored_environments_continue_identically_in_both_directions() {
    let (_place, _engine, mut trainer) = Place::started(NUM_ENVS, 1);
    reset(&mut trainer, 0);
    let mut player = Player::new(&PoolConfig::new(ID, NUM_ENVS));
    player.reset(ResetRequest::Seed(3));
    play_both(&mut trainer, &mut player, 0..40);

    // The engine's snapshots equal the pool's, and taking them changes no state.
    let taken: Vec<_> = (0..NUM_ENVS).map(|env| trainer.snapshot(0, env, TIMEOUT).unwrap()).collect();
    for (env, snapshot) in taken.iter().enumerate() {
        assert_eq!(*snapshot, player.pool.snapshot(env).unwrap());
    }
    play_both(&mut trainer, &mut player, 40..200);

    // Restore both, with the environments in reverse order.
    for (env, snapshot) in taken.iter().rev().enumerate() {
        trainer.restore(0, env, snapshot, TIMEOUT).unwrap();
        player.pool.restore(env, snapshot).unwrap();
    }
    trainer.reset(0, ResetRequest::Each(&[EnvReset::Keep; NUM_ENVS])).unwrap();
    let shown = trainer.receive(0, TIMEOUT).unwrap();
    player.observe();
    assert!(shown.batch().bytes() == player.bytes());
    assert_eq!(shown.step(), 202, "a snapshot is not counted as a batch");
    drop(shown);
    play_both(&mut trainer, &mut player, 200..300);
}

#[test]
fn mistakes_are_typed_errors() {
    let (place, _engine, mut trainer) = Place::started(NUM_ENVS, 1);
    assert_rejected(trainer.snapshot(0, 0, TIMEOUT), Rejection::NotReset, "reset");
    reset(&mut trainer, 0);
    let snapshot = trainer.snapshot(0, 0, TIMEOUT).unwrap();
    assert_rejected(trainer.snapshot(0, NUM_ENVS, TIMEOUT), Rejection::Snapshot, "env must be 0 to 2, got 3");
    assert_rejected(trainer.restore(0, NUM_ENVS, &snapshot, TIMEOUT), Rejection::Snapshot, "env must be 0 to 2, got 3");
    assert_rejected(trainer.restore(0, 0, &snapshot[1..], TIMEOUT), Rejection::Snapshot, "not a snapshot");
    assert_rejected(trainer.restore(0, 0, &[], TIMEOUT), Rejection::Snapshot, "not a snapshot");
    assert_error!(trainer.snapshot(1, 0, TIMEOUT), ServiceError::NoSuchGroup { given: 1, .. });
    let long = vec![0; SNAPSHOT_BYTES + 1];
    assert_error!(trainer.restore(0, 0, &long, TIMEOUT), ServiceError::SnapshotTooLong { .. });
    trainer.reset(0, ResetRequest::All).unwrap();
    assert_error!(trainer.snapshot(0, 0, TIMEOUT), ServiceError::AnswerPending { group: 0 });
    trainer.receive(0, TIMEOUT).unwrap();

    // A new trainer must reset first.
    drop(trainer);
    let mut next = place.trainer("gym").unwrap();
    assert_rejected(next.restore(0, 0, &snapshot, TIMEOUT), Rejection::NotReset, "reset");
    drop(next);

    // Lengths beyond the payload are rejected.
    let (foreign, good) = Foreign::of(&place);
    assert_eq!(foreign.ask(good, foreign.blocks(), |_| {}).unwrap().0, 0);
    for bytes in [u64::MAX, 1 << 40] {
        let (status, text) = foreign.ask(RequestHeader { kind: 6, bytes, ..good }, foreign.blocks(), |_| {}).unwrap();
        assert!(status != 0 && text.contains("not a snapshot"), "{text}");
    }
}

#[test]
fn a_late_snapshot_is_returned_by_the_same_call() {
    let (_place, engine, mut trainer) = Place::started(NUM_ENVS, 1);
    reset(&mut trainer, 0);
    let expected = trainer.snapshot(0, 1, TIMEOUT).unwrap();
    engine.stop();
    let short = Duration::from_millis(100);
    assert_error!(trainer.snapshot(0, 1, short), ServiceError::TimedOut { .. });
    assert_error!(trainer.receive(0, TIMEOUT), ServiceError::NothingSent { group: 0 });
    engine.resume();
    assert_error!(trainer.receive_any(TIMEOUT), ServiceError::NothingPending);
    assert_eq!(trainer.snapshot(0, 1, TIMEOUT).unwrap(), expected);

    // Another request replaces it: for another environment, with another snapshot, or a step.
    let other = trainer.snapshot(0, 2, TIMEOUT).unwrap();
    engine.stop();
    assert_error!(trainer.snapshot(0, 1, short), ServiceError::TimedOut { .. });
    assert_error!(trainer.restore(0, 0, &expected, short), ServiceError::TimedOut { .. });
    assert_error!(trainer.restore(0, 0, &other, short), ServiceError::TimedOut { .. });
    engine.resume();
    trainer.restore(0, 0, &other, TIMEOUT).unwrap();
    assert_eq!(trainer.snapshot(0, 0, TIMEOUT).unwrap(), other);
    engine.stop();
    assert_error!(trainer.snapshot(0, 1, short), ServiceError::TimedOut { .. });
    let actions = actions(&trainer, 0);
    trainer.send(0, &actions).unwrap();
    assert_error!(trainer.snapshot(0, 1, TIMEOUT), ServiceError::AnswerPending { group: 0 });
    engine.resume();
    assert_eq!(trainer.receive(0, TIMEOUT).unwrap().batch().episode_length(), [1; NUM_ENVS]);
}

#[test]
fn a_snapshot_with_a_thousand_spotlights_fits_into_a_message() {
    let place = Place::new();
    let options = serde_json::json!({"initial_spawns": 1000, "num_spawns": 1000, "spot_damage": 0.0});
    let options = ResetOptions::Shared(options.as_object().unwrap().clone());
    let pool = PoolConfig::new("SearingSpotlights-v0", 1).options(options).features(true).frames(None);
    let config = EngineConfig::new("gym", pool, 1);
    let _engine = Engine::new(memory_gym(), &config.namespace(place.namespace().clone())).unwrap().spawn().unwrap();
    let mut trainer = place.trainer("gym").unwrap();
    reset(&mut trainer, 0);
    let mut longest = 0;
    for _ in 0..100 {
        trainer.send(0, &[1, 2]).unwrap();
        trainer.receive(0, TIMEOUT).unwrap();
        let snapshot = trainer.snapshot(0, 0, TIMEOUT).unwrap();
        trainer.restore(0, 0, &snapshot, TIMEOUT).unwrap();
        longest = longest.max(snapshot.len());
    }
    assert!((80_000..SNAPSHOT_BYTES).contains(&longest), "{longest}");
}
