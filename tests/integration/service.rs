//! The service with real processes: engines and trainers are started, killed and restarted.

use std::fs::File;
use std::time::{Duration, Instant};

use crate::support::foreign::{self, Foreign, RequestHeader};
use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::TIMEOUT;
use crate::support::service::{ID, assert_error, assert_rejected, observed, play, send, step, try_step};
use endless_gym::batch::Block;
use endless_gym::envs::{ActionError, ActionSpace};
use endless_gym::memory_gym;
use endless_gym::pool::{EnvReset, PoolConfig, ResetRequest};
use endless_gym::service::{
    ConnectConfig, Engine, EngineStatus, Namespace, Observer, Rejection, ServiceError, ServiceSpecification, Trainer,
    running_engines,
};
use endless_gym_core::batch::{ActionSection, Contents, action_layout, batch_layout};

#[test]
fn groups_are_reset_and_stepped_independently() {
    let (_place, _engine, mut trainer) = Place::started(4, 2);
    let specification = trainer.specification().clone();
    assert_eq!((specification.groups, specification.num_envs), (2, 4));
    assert_eq!(specification.service, "gym");

    trainer.reset(0, ResetRequest::Seed(7)).unwrap();
    trainer.reset(1, ResetRequest::Seed(7)).unwrap();
    let second = trainer.receive(1, TIMEOUT).unwrap();
    let first = trainer.receive(0, TIMEOUT).unwrap();
    assert_eq!((first.group(), second.group()), (0, 1));
    // Seeds are numbered across groups: environment i of group g is seeded with 7 + 4 g + i, as in one pool with all
    // environments.
    let mut pool = Player::new(&PoolConfig::new(ID, 8));
    pool.reset(ResetRequest::Seed(7));
    let expected = pool.batch().observation();
    let (expected_first, expected_second) = expected.split_at(expected.len() / 2);
    assert!(first.batch().observation() == expected_first);
    assert!(second.batch().observation() == expected_second);
    assert!(expected_first != expected_second);
    assert_eq!(first.batch().episode_length(), [0; 4]);

    let actions = vec![1; 4 * specification.action_space.width()];
    trainer.send(0, &actions).unwrap();
    let stepped = trainer.receive_any(TIMEOUT).unwrap();
    assert_eq!((stepped.group(), stepped.step()), (0, 2));
    assert_eq!(stepped.batch().episode_length(), [1; 4]);
    assert_eq!(first.batch().episode_length(), [0; 4], "a held batch does not change");

    trainer.reset(0, ResetRequest::Each(&[EnvReset::Keep, EnvReset::Seed(7), EnvReset::Keep, EnvReset::Next])).unwrap();
    let again = trainer.receive(0, TIMEOUT).unwrap();
    assert_eq!(again.batch().episode_length(), [1, 0, 1, 0]);
    drop((first, stepped));

    let options = serde_json::from_str(r#"{"arena_size": 3}"#).unwrap();
    trainer.reset_with(1, ResetRequest::Seed(7), Some(&options)).unwrap();
    let smaller = trainer.receive(1, TIMEOUT).unwrap();
    assert!(smaller.batch().observation() != second.batch().observation());
    let wrong = serde_json::from_str(r#"{"agent_size": 1}"#).unwrap();
    trainer.reset_with(1, ResetRequest::All, Some(&wrong)).unwrap();
    assert_rejected(trainer.receive(1, TIMEOUT), Rejection::Pool, "agent_size");
    let long = serde_json::from_value(serde_json::json!({"command_show_delay": vec![1; 20_000]})).unwrap();
    assert_error!(trainer.reset_with(1, ResetRequest::All, Some(&long)), ServiceError::OptionsTooLong { .. });
}

#[test]
fn mistakes_of_a_trainer_are_typed_errors() {
    let place = Place::new();
    let engine = Engine::new(memory_gym(), &place.engine_config("gym", 2, 1)).unwrap().spawn().unwrap();
    let mut trainer = place.trainer("gym").unwrap();
    let width = trainer.specification().action_space.width();

    assert_error!(trainer.reset(1, ResetRequest::All), ServiceError::NoSuchGroup { given: 1, .. });
    assert_error!(trainer.receive(0, TIMEOUT), ServiceError::NothingSent { group: 0 });
    assert_error!(trainer.receive_any(TIMEOUT), ServiceError::NothingPending);
    let reset = ResetRequest::Each(&[EnvReset::Next]);
    assert_error!(trainer.reset(0, reset), ServiceError::ResetCount { given: 1, num_envs: 2 });
    let wrong = trainer.send(0, &[0]);
    assert_error!(wrong, ServiceError::Action(ActionError::Count { given: 1, num_envs: 2, .. }));

    // The environments must be reset before the first step.
    trainer.send(0, &vec![0; 2 * width]).unwrap();
    assert_rejected(trainer.receive(0, TIMEOUT), Rejection::NotReset, "");

    trainer.reset(0, ResetRequest::All).unwrap();
    assert_error!(trainer.reset(0, ResetRequest::All), ServiceError::AnswerPending { group: 0 });
    // The number of actions is checked before the pending answer, their range after it.
    assert_error!(trainer.send(0, &[0]), ServiceError::Action(ActionError::Count { .. }));
    assert_error!(trainer.send(0, &vec![99; 2 * width]), ServiceError::AnswerPending { group: 0 });
    trainer.receive(0, TIMEOUT).unwrap();

    let mut actions = vec![0; 2 * width];
    actions[width] = 99;
    let wrong = trainer.send(0, &actions);
    assert_error!(wrong, ServiceError::Action(ActionError::Range { env: 1, given, .. }) if given.starts_with("[99"));

    let mut held = Vec::new();
    for _ in 0..trainer.specification().batches_held {
        held.push(step(&mut trainer, 0));
    }
    assert_error!(try_step(&mut trainer, 0), ServiceError::TooManyBatchesHeld { group: 0, limit: 3 });
    held.remove(0);
    held.push(trainer.receive(0, TIMEOUT).unwrap());
    assert!(held.windows(2).all(|pair| pair[0].step() + 1 == pair[1].step()));

    engine.stop();
    let summary = engine.join().unwrap();
    assert_eq!((summary.batches, summary.env_steps, summary.rejected), (5, 8, 1));
}

#[test]
fn a_second_trainer_and_a_second_engine_are_refused() {
    let place = Place::new();
    let engine = place.engine("gym", 1, 1);
    let _trainer = place.trainer("gym").unwrap();
    let own = std::process::id();
    assert_error!(place.trainer("gym"), ServiceError::TrainerExists { pid: Some(pid), .. } if *pid == own);
    let second = Engine::new(memory_gym(), &place.engine_config("gym", 1, 1));
    let error = assert_error!(second, ServiceError::EngineExists { pid: Some(pid), .. } if *pid == engine.id());
    assert!(error.to_string().contains("gym"));
}

#[test]
fn the_error_for_an_unknown_engine_lists_the_running_ones() {
    let place = Place::new();
    let alone = place.trainer_now("gym").map(drop).unwrap_err();
    assert!(alone.to_string().contains("running engines: none"), "{alone}");
    let _engine = place.engine("other", 1, 1);
    place.trainer("other").unwrap();
    let error =
        assert_error!(place.trainer_now("gym"), ServiceError::UnknownEngine { service, .. } if service == "gym");
    assert!(error.to_string().contains("running engines: other"), "{error}");
    assert_eq!(running_engines(place.namespace()).unwrap(), ["other"]);
    let config = ConnectConfig::new("a/b").namespace(place.namespace().clone());
    assert_error!(Trainer::connect(&config), ServiceError::InvalidName { .. });
}

#[test]
fn observers_see_the_newest_batch_and_do_not_slow_the_trainer() {
    let (place, _engine, mut trainer) = Place::started(2, 1);
    let config = place.connect_config("gym");
    let mut observer = Observer::connect(&config, 0).unwrap();
    assert!(observer.newest().unwrap().is_none());
    play(&mut trainer, 0, 10);
    let seen = observed(&mut observer, 11);
    assert_eq!(seen.step(), 11);
    // An observer that holds batches reaches its own limit and does not affect the trainer.
    let mut held = vec![seen];
    while held.len() < 3 {
        play(&mut trainer, 0, 1);
        held.push(observer.next(TIMEOUT).unwrap());
    }
    play(&mut trainer, 0, 10);
    assert_error!(observer.newest(), ServiceError::TooManyBatchesHeld { .. });
    assert_error!(Observer::connect(&config, 1), ServiceError::NoSuchGroup { .. });
    let others: Vec<_> = (0..2).map(|_| Observer::connect(&config, 0).unwrap()).collect();
    assert_error!(Observer::connect(&config, 0), ServiceError::TooManyObservers { limit: 3, .. });
    drop(others);
    play(&mut trainer, 0, 1);
}

#[test]
fn a_trainer_reconnects_to_the_successor_of_a_killed_engine() {
    let (place, mut engine, mut trainer) = Place::started(2, 1);
    play(&mut trainer, 0, 3);
    let held = step(&mut trainer, 0);
    let frame = held.batch().observation().to_vec();

    engine.kill();
    let start = Instant::now();
    assert_error!(try_step(&mut trainer, 0), ServiceError::EngineLost { pid, .. } if *pid == engine.id());
    assert!(start.elapsed() < Duration::from_secs(2), "{:?}", start.elapsed());
    assert_error!(trainer.reconnect(Duration::ZERO), ServiceError::UnknownEngine { .. });

    let mut engine = place.engine("gym", 2, 1);
    trainer.reconnect(TIMEOUT).unwrap();
    play(&mut trainer, 0, 3);
    assert_eq!(held.batch().observation(), frame, "a batch of a dead engine remains readable");

    // Replace the engine before the trainer checks whether it is running.
    engine.kill();
    let mut engine = place.engine("gym", 2, 1);
    Observer::connect(&place.connect_config("gym"), 0).unwrap();
    assert_error!(try_step(&mut trainer, 0), ServiceError::EngineRestarted { .. });
    trainer.reconnect(TIMEOUT).unwrap();
    play(&mut trainer, 0, 3);

    // An engine that serves something else is not a successor.
    engine.kill();
    let _engine = place.engine("gym", 3, 1);
    assert_error!(
        trainer.reconnect(TIMEOUT),
        ServiceError::SpecificationChanged { what: "number of environments", .. }
    );
    drop(trainer);
    play(&mut place.trainer("gym").unwrap(), 0, 3);
}

#[test]
fn an_engine_that_ends_gives_up_its_name_without_the_lock() {
    let place = Place::new();
    let engine = Engine::new(memory_gym(), &place.engine_config("gym", 1, 1)).unwrap();
    let lock = File::open(place.root()).unwrap();
    lock.lock().unwrap();
    std::thread::scope(|scope| {
        let ending = scope.spawn(|| drop(engine));
        std::thread::sleep(Duration::from_millis(200));
        assert_eq!(EngineStatus::all(place.namespace()), []);
        lock.unlock().unwrap();
        ending.join().unwrap();
    });
    place.assert_nothing_left();
}

#[test]
fn a_trainer_notices_that_its_engine_has_ended() {
    let (_place, engine, mut trainer) = Place::started(1, 1);
    play(&mut trainer, 0, 1);
    engine.end();
    assert_error!(try_step(&mut trainer, 0), ServiceError::EngineLost { .. });
}

#[test]
fn a_trainer_reports_a_lost_engine_while_the_namespace_is_locked() {
    let (place, mut engine, mut trainer) = Place::started(1, 1);
    play(&mut trainer, 0, 1);
    step(&mut trainer, 0);
    engine.kill();
    let lock = File::open(place.root()).unwrap();
    lock.lock().unwrap();
    let (report, reported) = std::sync::mpsc::channel();
    std::thread::scope(|scope| {
        scope.spawn(move || {
            report.send(try_step(&mut trainer, 0).map(drop)).unwrap();
        });
        // Waiting for the lock would take 5 seconds.
        let result = reported.recv_timeout(Duration::from_secs(4));
        lock.unlock().unwrap();
        assert_error!(result.expect("the trainer waits for the lock"), ServiceError::EngineLost { .. });
    });
}

#[test]
fn a_waiting_observer_notices_that_its_engine_has_died() {
    let place = Place::new();
    let mut engine = place.engine("gym", 1, 1);
    let mut observer = Observer::connect(&place.connect_config("gym"), 0).unwrap();
    engine.kill();
    let (report, reported) = std::sync::mpsc::channel();
    std::thread::spawn(move || report.send(observer.next(Duration::MAX).map(drop)));
    let seen = reported.recv_timeout(Duration::from_secs(60)).expect("the observer still waits");
    assert_error!(seen, ServiceError::EngineLost { pid, .. } if *pid == engine.id());
}

#[test]
fn a_late_answer_can_be_received_after_a_timeout() {
    let (_place, engine, mut trainer) = Place::started(1, 1);
    play(&mut trainer, 0, 1);
    engine.stop();
    send(&mut trainer, 0);
    assert_error!(trainer.receive(0, Duration::from_millis(700)), ServiceError::TimedOut { .. });
    assert_error!(trainer.receive(0, Duration::ZERO), ServiceError::TimedOut { .. });
    engine.resume();
    assert_eq!(trainer.receive(0, TIMEOUT).unwrap().step(), 3);
}

#[test]
fn nothing_is_left_behind() {
    let (place, engine, mut trainer) = Place::started(2, 2);
    play(&mut trainer, 1, 2);
    assert!(!place.leftovers().is_empty());
    trainer.reset(0, ResetRequest::All).unwrap();
    let held = trainer.receive(0, TIMEOUT).unwrap();
    engine.end();
    drop(trainer);
    drop(held);
    place.assert_nothing_left();

    // After a crash, the next process that joins removes everything.
    let mut engine = place.engine("gym", 2, 2);
    place.trainer("gym").unwrap();
    engine.kill();
    assert!(!place.leftovers().is_empty());
    assert_eq!(running_engines(place.namespace()).unwrap(), [] as [String; 0]);
    place.assert_nothing_left();
}

#[test]
fn bad_messages_are_answered_with_rejections() {
    let place = Place::new();
    let _engine = place.engine("gym", 2, 1);
    let (foreign, good) = Foreign::of(&place);
    assert_eq!(foreign.ask(good, foreign.blocks(), |_| {}).unwrap().0, 0);

    let version = RequestHeader { layout_version: 77, ..good };
    let step = RequestHeader { kind: 1, ..good };
    let actions_of = |number: i32| {
        let layout = &foreign.specification.action;
        move |blocks: &mut [Block]| layout.write::<i32>(blocks, ActionSection::Action).fill(number)
    };
    let whole = foreign.blocks();
    for (answer, part) in [
        (foreign.ask(version, whole, |_| {}), "77"),
        (foreign.ask(RequestHeader { kind: 55, ..good }, whole, |_| {}), "55"),
        (foreign.ask(step, 1, |_| {}), "got 1"),
        (foreign.ask(step, whole, actions_of(-1)), "-1"),
    ] {
        let (status, text) = answer.unwrap();
        assert!(status != 0 && text.contains(part), "{text}");
    }
    let earlier = RequestHeader { incarnation: good.incarnation.wrapping_sub(1), ..good };
    assert_eq!(foreign.ask(earlier, foreign.blocks(), |_| {}), None, "a request for another incarnation is dropped");

    // The engine still answers.
    assert_eq!(foreign.ask(step, whole, actions_of(0)).unwrap().0, 0);
    drop(foreign);
    play(&mut place.trainer("gym").unwrap(), 0, 3);
}

#[test]
fn another_version_is_refused_with_both_numbers() {
    let place = Place::new();
    let _old = foreign::engine_of_version(place.namespace(), "old", 999);
    let error = assert_error!(place.trainer_now("old"), ServiceError::Version { layout, .. } if layout == "999");
    let own =
        concat!("(endless-gym ", env!("CARGO_PKG_VERSION"), "), got 999 (endless-gym 0.0.9); install the same version");
    assert!(error.to_string().contains(own), "{error}");
}

const CONTENTS: Contents = Contents { frames: None, features: false, state: false, final_observation: false };

#[test]
fn a_malformed_specification_is_an_error_and_not_a_panic() {
    let place = Place::new();
    let _engine = place.engine("gym", 1, 1);
    let published = place.trainer("gym").unwrap().specification().clone();
    let valid = ServiceSpecification { service: "malformed".to_owned(), ..published.clone() };
    let malformed = [
        ("groups", ServiceSpecification { groups: 0, ..valid.clone() }),
        ("num_envs", ServiceSpecification { num_envs: 0, ..valid.clone() }),
        ("batches_held", ServiceSpecification { batches_held: 0, ..valid.clone() }),
        (
            "action",
            ServiceSpecification {
                action: action_layout(&memory_gym().spec(ID).unwrap().action_space, 2).unwrap(),
                ..valid.clone()
            },
        ),
        (
            "batch",
            ServiceSpecification {
                batch: batch_layout(memory_gym().spec(ID).unwrap(), 2, CONTENTS).unwrap(),
                ..valid.clone()
            },
        ),
        (
            "action must be the layout of actions in MultiDiscrete([3, 3, 3])",
            ServiceSpecification { action_space: ActionSpace::multi_discrete(&[3, 3, 3]), ..valid.clone() },
        ),
        ("info must name", ServiceSpecification { info: vec![], ..valid.clone() }),
        ("features must name", ServiceSpecification { features: vec!["x".to_owned()], ..valid.clone() }),
        ("service must be `malformed`, got `gym`", published),
    ];
    for (part, specification) in malformed {
        let _published = foreign::specification(place.namespace(), "malformed", &specification);
        let found = place.trainer_now("malformed");
        assert_error!(found, ServiceError::Specification { reason, .. } if reason.contains(part));
    }
}

#[test]
fn messages_of_another_type_are_refused() {
    let place = Place::new();
    let _engine = place.engine("gym", 1, 1);
    let specification = place.trainer("gym").unwrap().specification().clone();
    let _other = foreign::engine_of_other_type(place.namespace(), "other", &specification);
    assert_error!(place.trainer_now("other"), ServiceError::IncompatibleTypes { .. });
}

/// Creates the leftovers of a killed engine.
fn remains(place: &Place, service: &str) {
    let mut engine = place.engine(service, 1, 1);
    place.trainer(service).unwrap();
    engine.kill();
}

#[test]
fn a_late_engine_finds_the_successor_of_a_dead_one() {
    let place = Place::new();
    remains(&place, "gym");
    let lock = File::open(place.root()).unwrap();
    lock.lock().unwrap();
    std::thread::scope(|scope| {
        let late = scope.spawn(|| Engine::new(memory_gym(), &place.engine_config("gym", 1, 1)).map(drop));
        std::thread::sleep(Duration::from_millis(500));
        // A successor takes the name while the other engine waits.
        let _successor = foreign::engine_of_version(place.namespace(), "gym", 999);
        lock.unlock().unwrap();
        assert_error!(late.join().unwrap(), ServiceError::EngineExists { .. });
        // The successor is still there.
        assert_error!(place.trainer_now("gym"), ServiceError::Version { layout, .. } if layout == "999");
    });
}

#[test]
fn of_several_engines_one_takes_the_name_of_a_dead_one() {
    let place = Place::new();
    remains(&place, "gym");
    std::thread::scope(|scope| {
        let start = || Engine::new(memory_gym(), &place.engine_config("gym", 1, 1));
        let threads: Vec<_> = (0..4).map(|_| scope.spawn(start)).collect();
        let started: Vec<_> = threads.into_iter().map(|thread| thread.join().unwrap()).collect();
        assert_eq!(started.iter().filter(|engine| engine.is_ok()).count(), 1);
        for error in started.iter().filter_map(|engine| engine.as_ref().err()) {
            assert!(matches!(error, ServiceError::EngineExists { .. }), "{error}");
        }
        assert_eq!(running_engines(place.namespace()).unwrap(), ["gym"]);
    });
}

#[test]
fn a_header_that_changes_after_its_check_is_not_read_again() {
    let (_place, mut foreign, mut observer) = foreign::observed(1);
    let mut header = foreign.send(5);
    let received = observer.newest().unwrap().unwrap();
    assert_eq!((received.group(), received.step()), (0, 5));
    let blocks = received.blocks().len();
    assert_eq!(blocks, observer.specification().batch.blocks());
    for forged in [0, 1 << 40] {
        header.overwrite(7, 99, forged);
        assert_eq!((received.group(), received.step(), received.blocks().len()), (0, 5, blocks));
        assert_eq!(received.batch().reward(), [0.0]);
    }
}

#[test]
fn trainers_and_batches_may_move_between_threads() {
    fn check<T: Send + Sync>() {}
    check::<Trainer>();
    check::<endless_gym::service::BatchLease>();
    check::<Observer>();
    fn movable<T: Send>() {}
    movable::<Engine>();
    check::<Namespace>();
}
