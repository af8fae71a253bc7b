//! Reset parameters of next episodes, and what running episodes follow from, through the service: as in a pool.

use std::time::Duration;

use crate::support::foreign::{Foreign, RequestHeader};
use crate::support::service::{ID, Place};
use endless_gym::batch::{Batch, zeroed};
use endless_gym::pool::{NextOptions, Pool, PoolConfig, ResetRequest, Threads};
use endless_gym::service::{Rejection, ServiceError};
use serde_json::json;

const SECONDS: Duration = Duration::from_secs(5);
const NUM_ENVS: usize = 40;

fn next(value: &serde_json::Value, envs: &[usize]) -> NextOptions {
    NextOptions { options: value.as_object().unwrap().clone(), envs: envs.to_vec() }
}

#[test]
fn options_of_next_episodes_are_those_of_a_pool() {
    let place = Place::new();
    let _engine = place.engine("gym", NUM_ENVS, 1);
    let mut trainer = place.trainer("gym").unwrap();
    let mut pool = Pool::new(&PoolConfig::new(ID, NUM_ENVS), &Threads::new(1).unwrap()).unwrap();
    let mut blocks = zeroed(pool.layout().blocks());
    // Long texts, so that the answers need several messages.
    let long = |count: u32, length: usize| json!({"command_count": [count], "explosion_delay": vec![4; length]});
    let first: Vec<_> = (0..NUM_ENVS).map(|env| next(&long(1, 4_000 + env), &[env])).collect();
    trainer.set_options(0, &first, SECONDS).unwrap();
    pool.set_options(&first).unwrap();
    trainer.reset(0, ResetRequest::Seed(7)).unwrap();
    trainer.receive(0, SECONDS).unwrap();
    pool.reset(ResetRequest::Seed(7), &mut blocks).unwrap();

    let later = [next(&json!({"command_count": [2]}), &[0, 5]), next(&json!({}), &[9])];
    let width = trainer.specification().action_space.branches().len();
    for step in 0..120 {
        if step == 10 {
            trainer.set_options(0, &later, SECONDS).unwrap();
            pool.set_options(&later).unwrap();
        }
        trainer.send(0, &vec![0; NUM_ENVS * width]).unwrap();
        let received = trainer.receive(0, SECONDS).unwrap();
        pool.step(&vec![0; NUM_ENVS * width], &mut blocks).unwrap();
        assert!(received.batch().observation() == Batch::new(pool.layout(), &blocks).observation());
    }
    let envs: Vec<usize> = (0..NUM_ENVS).rev().collect();
    let expected: Vec<_> = (0..NUM_ENVS).map(|env| pool.running_episode(env).unwrap()).collect();
    assert!(trainer.running_episodes(0, &envs, SECONDS).unwrap() == expected);
    assert_eq!(expected[5].options, later[0].options);
    assert!(expected[9].options.is_empty());
    assert_eq!(trainer.running_episodes(0, &[9, 3, 9], SECONDS).unwrap(), [expected[3].clone(), expected[9].clone()]);
    assert!(trainer.running_episodes(0, &[], SECONDS).unwrap().is_empty());
    for env in 0..NUM_ENVS {
        assert_eq!(trainer.snapshot(0, env, SECONDS).unwrap(), pool.snapshot(env).unwrap());
    }
}

#[test]
fn mistakes_are_typed_errors() {
    let place = Place::new();
    let _engine = place.engine("gym", 2, 1);
    let mut trainer = place.trainer("gym").unwrap();
    let rejected = |error: ServiceError, part: &str, expected: Rejection| {
        assert!(matches!(error, ServiceError::Rejected { reason, .. } if reason == expected), "{error}");
        assert!(error.to_string().contains(part), "{error}");
    };
    rejected(trainer.running_episodes(0, &[0], SECONDS).unwrap_err(), "reset", Rejection::NotReset);
    trainer.reset(0, ResetRequest::Seed(1)).unwrap();
    trainer.receive(0, SECONDS).unwrap();
    let before = trainer.snapshot(0, 0, SECONDS).unwrap();
    let (good, wrong) = (json!({"arena_size": 3}), json!({"agent_size": 1}));
    let refused = trainer.set_options(0, &[next(&good, &[0]), next(&wrong, &[1])], SECONDS).unwrap_err();
    rejected(refused, "agent_size", Rejection::Pool);
    let refused = trainer.set_options(0, &[next(&good, &[0, 2])], SECONDS).unwrap_err();
    rejected(refused, "env must be 0 to 1, got 2", Rejection::Pool);
    let long = json!({"command_show_delay": vec![1; 20_000]});
    let refused = trainer.set_options(0, &[next(&good, &[0]), next(&long, &[1])], SECONDS).unwrap_err();
    assert!(matches!(refused, ServiceError::OptionsTooLong { .. }));
    assert!(matches!(trainer.running_episodes(0, &[2], SECONDS), Err(ServiceError::Pool(_))));
    assert!(matches!(trainer.set_options(1, &[next(&good, &[0])], SECONDS), Err(ServiceError::NoSuchGroup { .. })));
    assert_eq!(trainer.snapshot(0, 0, SECONDS).unwrap(), before);
    trainer.send(0, &[0, 0]).unwrap();
    let pending = trainer.set_options(0, &[next(&good, &[0])], SECONDS).unwrap_err();
    assert!(matches!(pending, ServiceError::AnswerPending { group: 0 }));
    trainer.receive(0, SECONDS).unwrap();

    // Texts that are no lists of options, and lengths beyond the payload.
    let specification = trainer.specification().clone();
    drop(trainer);
    let foreign = Foreign::new(place.namespace(), &specification);
    let good = RequestHeader::reset_all(&specification);
    for bytes in [0, 5, u64::MAX] {
        let (status, text) = foreign.ask(RequestHeader { kind: 8, bytes, ..good }, foreign.blocks(), |_| {}).unwrap();
        assert!(status != 0 && text.contains("options of next episodes must be a JSON list"), "{text}");
    }
    let (_, text) = foreign.ask(RequestHeader { kind: 10, ..good }, foreign.blocks(), |_| {}).unwrap();
    assert!(text.contains("request kind must be 1 to 9, got 10"), "{text}");
}
