//! Tests how often a request was executed with real processes: each row of the table in the documentation of
//! `endless-gym-service`.

use std::time::Duration;

use crate::support::place::Place;
use crate::support::process::{Process, TIMEOUT, wait_until};
use crate::support::service::{assert_error, assert_rejected, send, step, try_step};
use endless_gym::pool::ResetRequest;
use endless_gym::service::{EngineActivity, EngineStatus, LastRequest, Observer, Rejection, ServiceError, Trainer};

const SHORT: Duration = Duration::from_millis(50);

fn status(place: &Place) -> EngineStatus {
    EngineStatus::of(place.namespace(), "gym").unwrap()
}

/// Resets group 0 of an engine and receives its first batch.
fn start(trainer: &mut Trainer) {
    trainer.reset(0, ResetRequest::Seed(1)).unwrap();
    assert_eq!(trainer.receive(0, TIMEOUT).unwrap().step(), 1);
}

#[test]
fn after_a_timeout_and_a_reconnection_a_step_is_played_once() {
    let (place, engine, mut trainer) = Place::started(2, 2);
    assert_eq!(trainer.reconnect(TIMEOUT).unwrap().groups[0].last_request, LastRequest::None);
    start(&mut trainer);
    engine.stop();
    send(&mut trainer, 0);
    let error = trainer.receive(0, SHORT).unwrap_err();
    let not_taken = EngineActivity::NotTaken { process: engine.id() };
    assert!(matches!(error, ServiceError::TimedOut { activity, .. } if activity == not_taken), "{error}");
    assert!(error.to_string().contains("has not taken the request"), "{error}");

    let found = trainer.reconnect(TIMEOUT).unwrap();
    assert!(!found.restarted);
    assert_eq!(found.incarnation, trainer.specification().incarnation);
    let first = found.groups[0];
    assert_eq!((first.step, first.lost_step, first.last_request), (Some(1), None, LastRequest::Pending));
    assert_eq!(found.groups[1].last_request, LastRequest::None);
    assert_error!(trainer.send_with(0, |actions| actions.fill(1)), ServiceError::AnswerPending { group: 0 });

    engine.resume();
    let received = trainer.receive(0, TIMEOUT).unwrap();
    assert_eq!((received.step(), received.batch().episode_length()), (2, &[1, 1][..]));
    drop(received);
    let found = trainer.reconnect(TIMEOUT).unwrap().groups[0];
    assert_eq!((found.step, found.last_request), (Some(2), LastRequest::Played));
    assert_eq!(step(&mut trainer, 0).batch().episode_length(), [2, 2]);
    assert_eq!(status(&place).groups[0].env_steps, 4);
}

#[test]
fn a_timeout_names_a_long_request_with_its_duration() {
    let (place, engine, mut trainer) = Place::started(1024, 2);
    let mut observer = Observer::connect(&place.connect_config("gym"), 1).unwrap();
    let activity = |observer: &mut Observer| match observer.next(SHORT) {
        Err(ServiceError::TimedOut { activity, .. }) => activity,
        other => panic!("{other:?}"),
    };
    assert_eq!(activity(&mut observer), EngineActivity::Idle { group: 1, since: None, process: engine.id() });
    // The engine draws every frame twice, which takes tens of milliseconds. On a busy machine it may be done before it is stopped.
    trainer.reset(1, ResetRequest::All).unwrap();
    wait_until("the engine stops in a reset", || {
        engine.stop();
        let is_busy = status(&place).groups[1].busy.is_some();
        if !is_busy {
            engine.resume();
            if trainer.receive(1, Duration::ZERO).is_ok() {
                while observer.next(SHORT).is_ok() {}
                trainer.reset(1, ResetRequest::All).unwrap();
            }
        }
        is_busy
    });
    trainer.reset(0, ResetRequest::All).unwrap();
    std::thread::sleep(SHORT);
    for group in [1, 0] {
        let error = trainer.receive(group, SHORT).unwrap_err();
        let ServiceError::TimedOut { activity: EngineActivity::Busy { group, kind, since, process }, .. } = error
        else {
            panic!("{error}");
        };
        assert_eq!((group, kind, process), (1, "reset", engine.id()));
        assert!(since >= SHORT);
        assert!(error.to_string().contains("the reset of group 1 has been running for 0."), "{error}");
    }
    assert!(matches!(activity(&mut observer), EngineActivity::Busy { group: 1, kind: "reset", .. }));
    engine.resume();
    trainer.receive(0, TIMEOUT).unwrap();
    trainer.receive(1, TIMEOUT).unwrap();
    assert_eq!(status(&place).groups[1].busy, None);
    observer.next(TIMEOUT).unwrap();
    let error = observer.next(SHORT).unwrap_err();
    assert!(error.to_string().contains("the trainer has requested nothing of group 1 for "), "{error}");
}

/// Starts a new engine of the same kind, connects the trainer to it, and returns the fate of the trainer's last
/// request.
fn replaced(place: &Place, trainer: &mut Trainer, num_envs: usize) -> (Process, LastRequest, Option<u64>) {
    let successor = place.engine("gym", num_envs, 1);
    let found = trainer.reconnect(TIMEOUT).unwrap();
    assert!(found.restarted);
    assert_eq!((found.incarnation, found.groups[0].step), (trainer.specification().incarnation, Some(0)));
    (successor, found.groups[0].last_request, found.groups[0].lost_step)
}

#[test]
fn reconnecting_after_an_engines_death_reports_the_fate_of_the_last_request() {
    let (place, mut engine, mut trainer) = Place::started(2, 1);

    // The engine dies before it takes the request.
    start(&mut trainer);
    engine.stop();
    send(&mut trainer, 0);
    engine.kill();
    assert_error!(trainer.receive(0, TIMEOUT), ServiceError::EngineLost { .. });
    let (mut engine, last, lost_step) = replaced(&place, &mut trainer, 2);
    assert_eq!((last, lost_step), (LastRequest::NotPlayed, Some(1)));

    // The engine dies after it has answered, before the answer is received.
    start(&mut trainer);
    send(&mut trainer, 0);
    wait_until("the engine answers", || status(&place).groups[0].step == 2);
    engine.kill();
    let (mut engine, last, lost_step) = replaced(&place, &mut trainer, 2);
    assert_eq!((last, lost_step), (LastRequest::Played, Some(2)));

    // The engine dies after everything is received.
    start(&mut trainer);
    engine.kill();
    let (mut engine, last, lost_step) = replaced(&place, &mut trainer, 2);
    assert_eq!((last, lost_step), (LastRequest::Played, Some(1)));

    // An answer that arrived before the engine's death can still be received. Once the observer has it, so does the
    // trainer's queue.
    start(&mut trainer);
    let mut observer = Observer::connect(&place.connect_config("gym"), 0).unwrap();
    send(&mut trainer, 0);
    assert_eq!(observer.next(TIMEOUT).unwrap().step(), 2);
    engine.kill();
    assert_eq!(trainer.receive(0, TIMEOUT).unwrap().step(), 2);
}

#[test]
fn the_fate_of_a_request_is_unknown_if_the_engine_dies_during_it() {
    let (place, mut engine, mut trainer) = Place::started(1024, 1);
    trainer.reset(0, ResetRequest::All).unwrap();
    wait_until("the reset runs", || status(&place).groups[0].busy.is_some());
    engine.kill();
    let (_engine, last, lost_step) = replaced(&place, &mut trainer, 1024);
    assert_eq!((last, lost_step), (LastRequest::Unknown, Some(0)));
}

#[test]
fn a_request_of_a_trainer_that_dies_or_is_dropped_is_played_at_most_once() {
    let place = Place::new();
    let engine = place.engine("gym", 2, 1);
    for dies in [false, true] {
        let before = if dies {
            let mut killed = place.role("trainer gym");
            wait_until("the trainer steps", || {
                status(&place).groups[0].trainer_process == Some(killed.id()) && status(&place).groups[0].env_steps >= 2
            });
            engine.stop();
            killed.kill();
            status(&place).groups[0].clone()
        } else {
            let mut trainer = place.trainer("gym").unwrap();
            start(&mut trainer);
            engine.stop();
            send(&mut trainer, 0);
            status(&place).groups[0].clone()
        };
        engine.resume();
        let mut next = place.trainer("gym").unwrap();
        assert_rejected(try_step(&mut next, 0), Rejection::NotReset, "");
        let after = status(&place).groups[0].clone();
        assert!((before.step..=before.step + 1).contains(&after.step), "{before:?} {after:?}");
        assert_eq!(after.rejected, before.rejected + 1);
    }
}

#[test]
fn a_rejected_request_changes_nothing_and_its_whole_explanation_arrives() {
    let (_place, _engine, mut trainer) = Place::started(2, 1);
    start(&mut trainer);
    let name = "ä".repeat(4000);
    let options = serde_json::json!({ name.clone(): 1 });
    trainer.reset_with(0, ResetRequest::All, options.as_object()).unwrap();
    assert_error!(trainer.receive(0, TIMEOUT), ServiceError::Rejected { message, .. } if message.contains(&name));
    let found = trainer.reconnect(TIMEOUT).unwrap().groups[0];
    assert_eq!((found.step, found.last_request), (Some(1), LastRequest::NotPlayed));
    // The batch that the explanation overwrote must be drawn in full; the engine checks every frame.
    for number in 2..8 {
        assert_eq!(step(&mut trainer, 0).step(), number);
    }
    trainer.restore(0, 0, &[], TIMEOUT).unwrap_err();
    assert_eq!(trainer.reconnect(TIMEOUT).unwrap().groups[0].last_request, LastRequest::NotPlayed);
    let snapshot = trainer.snapshot(0, 0, TIMEOUT).unwrap();
    trainer.restore(0, 1, &snapshot, TIMEOUT).unwrap();
    assert_eq!(trainer.reconnect(TIMEOUT).unwrap().groups[0].last_request, LastRequest::Played);
}
