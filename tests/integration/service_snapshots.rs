//! Snapshots through the service: they equal those of a pool in this process and can be restored in both.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crate::support::foreign::{Foreign, RequestHeader};
use crate::support::service::{ID, Place};
use endless_gym::pool::{Pool, PoolConfig, ResetOptions, ResetRequest, Threads};
use endless_gym::service::{Engine, EngineConfig, Rejection, ServiceError, Trainer};
use endless_gym_core::batch::{Block, SNAPSHOT_BYTES, zeroed};
use rustix::process::{Pid, Signal, kill_process};

const SECONDS: Duration = Duration::from_secs(5);
const NUM_ENVS: usize = 3;

/// Actions that differ from step to step and between environments.
fn actions(trainer: &Trainer, step: usize) -> Vec<i32> {
    let branches = trainer.specification().action_space.branches();
    (0..NUM_ENVS).flat_map(|env| branches.iter().map(move |n| ((step * 7 + env * 3) % *n as usize) as i32)).collect()
}

/// Steps an engine's environments and those of a pool, and compares the batches.
fn play_both(trainer: &mut Trainer, pool: &mut Pool, steps: std::ops::Range<usize>) {
    let mut blocks = zeroed(pool.layout().blocks());
    for step in steps {
        let actions = actions(trainer, step);
        trainer.send(0, &actions).unwrap();
        let received = trainer.receive(0, SECONDS).unwrap();
        pool.step(&actions, &mut blocks).unwrap();
        same(&received.batch(), pool, &blocks);
    }
}

fn same(batch: &endless_gym::batch::Batch<'_>, pool: &Pool, blocks: &[Block]) {
    let expected = endless_gym::batch::Batch::new(pool.layout(), blocks);
    assert!(batch.observation() == expected.observation());
    assert_eq!(batch.reward(), expected.reward());
    assert_eq!(batch.episode_length(), expected.episode_length());
}

fn reset(trainer: &mut Trainer, seed: u64) {
    trainer.reset(0, ResetRequest::Seed(seed)).unwrap();
    trainer.receive(0, SECONDS).unwrap();
}

#[test]
fn restored_environments_continue_identically_in_both_directions() {
    let place = Place::new();
    let _engine = place.engine("gym", NUM_ENVS, 1);
    let mut trainer = place.trainer("gym").unwrap();
    reset(&mut trainer, 7);
    let mut pool = Pool::new(&PoolConfig::new(ID, NUM_ENVS), &Threads::new(1).unwrap()).unwrap();
    let mut blocks = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::Seed(7), &mut blocks).unwrap();
    play_both(&mut trainer, &mut pool, 0..40);

    // The engine's snapshots equal the pool's, and taking them changes no state.
    let taken: Vec<_> = (0..NUM_ENVS).map(|env| trainer.snapshot(0, env, SECONDS).unwrap()).collect();
    for (env, snapshot) in taken.iter().enumerate() {
        assert_eq!(*snapshot, pool.snapshot(env).unwrap());
    }
    play_both(&mut trainer, &mut pool, 40..200);

    // Both are restored, with the environments in reverse order.
    for (env, snapshot) in taken.iter().rev().enumerate() {
        trainer.restore(0, env, snapshot, SECONDS).unwrap();
        pool.restore(env, snapshot).unwrap();
    }
    trainer.reset(0, ResetRequest::Each { reset: &[0; NUM_ENVS], seed: &[0; NUM_ENVS] }).unwrap();
    let shown = trainer.receive(0, SECONDS).unwrap();
    pool.observe(&mut blocks).unwrap();
    same(&shown.batch(), &pool, &blocks);
    assert_eq!(shown.step(), 202, "a snapshot is not counted as a batch");
    drop(shown);
    play_both(&mut trainer, &mut pool, 200..300);
}

#[test]
fn mistakes_are_typed_errors() {
    let place = Place::new();
    let _engine = place.engine("gym", NUM_ENVS, 1);
    let mut trainer = place.trainer("gym").unwrap();
    let rejected = |error: ServiceError, part: &str, expected: Rejection| {
        assert!(matches!(error, ServiceError::Rejected { reason, .. } if reason == expected), "{error}");
        assert!(error.to_string().contains(part), "{error}");
    };
    rejected(trainer.snapshot(0, 0, SECONDS).unwrap_err(), "reset", Rejection::NotReset);
    reset(&mut trainer, 1);
    let snapshot = trainer.snapshot(0, 0, SECONDS).unwrap();
    rejected(trainer.snapshot(0, NUM_ENVS, SECONDS).unwrap_err(), "env must be 0 to 2, got 3", Rejection::Snapshot);
    rejected(
        trainer.restore(0, NUM_ENVS, &snapshot, SECONDS).unwrap_err(),
        "env must be 0 to 2, got 3",
        Rejection::Snapshot,
    );
    rejected(trainer.restore(0, 0, &snapshot[1..], SECONDS).unwrap_err(), "not a snapshot", Rejection::Snapshot);
    rejected(trainer.restore(0, 0, &[], SECONDS).unwrap_err(), "not a snapshot", Rejection::Snapshot);
    assert!(matches!(trainer.snapshot(1, 0, SECONDS), Err(ServiceError::NoSuchGroup { given: 1, .. })));
    let long = vec![0; SNAPSHOT_BYTES + 1];
    assert!(matches!(trainer.restore(0, 0, &long, SECONDS), Err(ServiceError::SnapshotTooLong { .. })));
    trainer.reset(0, ResetRequest::All).unwrap();
    assert!(matches!(trainer.snapshot(0, 0, SECONDS), Err(ServiceError::AnswerPending { group: 0 })));
    trainer.receive(0, SECONDS).unwrap();

    // A new trainer must reset first.
    drop(trainer);
    let mut next = place.trainer("gym").unwrap();
    rejected(next.restore(0, 0, &snapshot, SECONDS).unwrap_err(), "reset", Rejection::NotReset);
    let specification = next.specification().clone();
    drop(next);

    // Lengths beyond the payload.
    let foreign = Foreign::new(place.namespace(), &specification);
    let good = RequestHeader::reset_all(&specification);
    assert_eq!(foreign.ask(good, foreign.blocks(), |_| {}).unwrap().0, 0);
    for bytes in [u64::MAX, 1 << 40] {
        let (status, text) = foreign.ask(RequestHeader { kind: 6, bytes, ..good }, foreign.blocks(), |_| {}).unwrap();
        assert!(status != 0 && text.contains("not a snapshot"), "{text}");
    }
}

#[test]
fn a_late_snapshot_is_returned_by_the_same_call() {
    let place = Place::new();
    let engine = place.engine("gym", NUM_ENVS, 1);
    let mut trainer = place.trainer("gym").unwrap();
    reset(&mut trainer, 1);
    let expected = trainer.snapshot(0, 1, SECONDS).unwrap();
    let pid = Pid::from_raw(engine.id() as i32).unwrap();
    kill_process(pid, Signal::STOP).unwrap();
    std::thread::sleep(Duration::from_millis(50));
    let short = Duration::from_millis(100);
    assert!(matches!(trainer.snapshot(0, 1, short), Err(ServiceError::TimedOut { .. })));
    assert!(matches!(trainer.receive(0, SECONDS), Err(ServiceError::NothingSent { group: 0 })));
    kill_process(pid, Signal::CONT).unwrap();
    assert!(matches!(trainer.receive_any(SECONDS), Err(ServiceError::NothingPending)));
    assert_eq!(trainer.snapshot(0, 1, SECONDS).unwrap(), expected);

    // Another request replaces it: another environment, another snapshot, a step.
    let other = trainer.snapshot(0, 2, SECONDS).unwrap();
    kill_process(pid, Signal::STOP).unwrap();
    std::thread::sleep(Duration::from_millis(50));
    assert!(matches!(trainer.snapshot(0, 1, short), Err(ServiceError::TimedOut { .. })));
    assert!(matches!(trainer.restore(0, 0, &expected, short), Err(ServiceError::TimedOut { .. })));
    assert!(matches!(trainer.restore(0, 0, &other, short), Err(ServiceError::TimedOut { .. })));
    kill_process(pid, Signal::CONT).unwrap();
    trainer.restore(0, 0, &other, SECONDS).unwrap();
    assert_eq!(trainer.snapshot(0, 0, SECONDS).unwrap(), other);
    kill_process(pid, Signal::STOP).unwrap();
    std::thread::sleep(Duration::from_millis(50));
    assert!(matches!(trainer.snapshot(0, 1, short), Err(ServiceError::TimedOut { .. })));
    let actions = actions(&trainer, 0);
    trainer.send(0, &actions).unwrap();
    assert!(matches!(trainer.snapshot(0, 1, SECONDS), Err(ServiceError::AnswerPending { group: 0 })));
    kill_process(pid, Signal::CONT).unwrap();
    assert_eq!(trainer.receive(0, SECONDS).unwrap().batch().episode_length(), [1; NUM_ENVS]);
}

#[test]
fn a_thousand_spotlights_fit() {
    let place = Place::new();
    let options = serde_json::json!({"initial_spawns": 1000, "num_spawns": 1000, "spot_damage": 0.0});
    let options = ResetOptions::Shared(options.as_object().unwrap().clone());
    let pool = PoolConfig { options, features: true, frames: None, ..PoolConfig::new("SearingSpotlights-v0", 1) };
    let config = EngineConfig::new("gym", pool, 1);
    let mut engine = Engine::new(&EngineConfig { namespace: place.namespace().clone(), ..config }).unwrap();
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| engine.run(&stop).unwrap());
        let mut trainer = place.trainer("gym").unwrap();
        reset(&mut trainer, 1);
        let mut longest = 0;
        for _ in 0..100 {
            trainer.send(0, &[1, 2]).unwrap();
            trainer.receive(0, SECONDS).unwrap();
            let snapshot = trainer.snapshot(0, 0, SECONDS).unwrap();
            trainer.restore(0, 0, &snapshot, SECONDS).unwrap();
            longest = longest.max(snapshot.len());
        }
        assert!((80_000..SNAPSHOT_BYTES).contains(&longest), "{longest}");
        stop.store(true, Ordering::Relaxed);
    });
}
