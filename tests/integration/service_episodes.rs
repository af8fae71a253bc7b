//! Tests that reset parameters of next episodes, and seed and options of running episodes, are the same through the
//! service as in a pool.

use crate::support::foreign::{Foreign, RequestHeader};
use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::TIMEOUT;
use crate::support::service::{ID, assert_error, assert_rejected, reset, send, step};
use endless_gym::pool::{NextOptions, PoolConfig, ResetRequest};
use endless_gym::service::{Rejection, ServiceError};
use serde_json::json;

const NUM_ENVS: usize = 40;

fn next(value: &serde_json::Value, envs: &[usize]) -> NextOptions {
    NextOptions { options: value.as_object().unwrap().clone(), envs: envs.to_vec() }
}

#[test]
fn next_options_and_running_episodes_equal_those_of_a_pool() {
    let (_place, _engine, mut trainer) = Place::started(NUM_ENVS, 1);
    let mut player = Player::new(&PoolConfig::new(ID, NUM_ENVS));
    // Long texts, so that the answers need several messages.
    let long = |count: u32, length: usize| json!({"command_count": [count], "explosion_delay": vec![4; length]});
    let first: Vec<_> = (0..NUM_ENVS).map(|env| next(&long(1, 4_000 + env), &[env])).collect();
    trainer.set_options(0, &first, TIMEOUT).unwrap();
    player.pool.set_options(&first).unwrap();
    reset(&mut trainer, 0);
    player.reset(ResetRequest::Seed(3));

    let later = [next(&json!({"command_count": [2]}), &[0, 5]), next(&json!({}), &[9])];
    for number in 0..120 {
        if number == 10 {
            trainer.set_options(0, &later, TIMEOUT).unwrap();
            player.pool.set_options(&later).unwrap();
        }
        let received = step(&mut trainer, 0);
        player.step_all(1);
        assert!(received.batch().observation() == player.batch().observation());
    }
    let envs: Vec<usize> = (0..NUM_ENVS).rev().collect();
    let expected: Vec<_> = (0..NUM_ENVS).map(|env| player.pool.running_episode(env).unwrap()).collect();
    assert!(trainer.running_episodes(0, &envs, TIMEOUT).unwrap() == expected);
    assert_eq!(expected[5].options, later[0].options);
    assert!(expected[9].options.is_empty());
    assert_eq!(trainer.running_episodes(0, &[9, 3, 9], TIMEOUT).unwrap(), [expected[3].clone(), expected[9].clone()]);
    assert!(trainer.running_episodes(0, &[], TIMEOUT).unwrap().is_empty());
    for env in 0..NUM_ENVS {
        assert_eq!(trainer.snapshot(0, env, TIMEOUT).unwrap(), player.pool.snapshot(env).unwrap());
    }
}

#[test]
fn mistakes_are_typed_errors() {
    let (place, _engine, mut trainer) = Place::started(2, 1);
    assert_rejected(trainer.running_episodes(0, &[0], TIMEOUT), Rejection::NotReset, "reset");
    reset(&mut trainer, 0);
    let before = trainer.snapshot(0, 0, TIMEOUT).unwrap();
    let (good, wrong) = (json!({"arena_size": 3}), json!({"agent_size": 1}));
    let refused = trainer.set_options(0, &[next(&good, &[0]), next(&wrong, &[1])], TIMEOUT);
    assert_rejected(refused, Rejection::Pool, "agent_size");
    let refused = trainer.set_options(0, &[next(&good, &[0, 2])], TIMEOUT);
    assert_rejected(refused, Rejection::Pool, "env must be 0 to 1, got 2");
    let long = json!({"command_show_delay": vec![1; 20_000]});
    let refused = trainer.set_options(0, &[next(&good, &[0]), next(&long, &[1])], TIMEOUT);
    assert_error!(refused, ServiceError::OptionsTooLong { .. });
    assert_error!(trainer.running_episodes(0, &[2], TIMEOUT), ServiceError::Pool(_));
    assert_error!(trainer.set_options(1, &[next(&good, &[0])], TIMEOUT), ServiceError::NoSuchGroup { .. });
    assert_eq!(trainer.snapshot(0, 0, TIMEOUT).unwrap(), before);
    send(&mut trainer, 0);
    let pending = trainer.set_options(0, &[next(&good, &[0])], TIMEOUT);
    assert_error!(pending, ServiceError::AnswerPending { group: 0 });
    trainer.receive(0, TIMEOUT).unwrap();

    // Texts that are not lists of options, and lengths beyond the payload.
    drop(trainer);
    let (foreign, good) = Foreign::of(&place);
    for bytes in [0, 5, u64::MAX] {
        let (status, text) = foreign.ask(RequestHeader { kind: 8, bytes, ..good }, foreign.blocks(), |_| {}).unwrap();
        assert!(status != 0 && text.contains("options of next episodes must be a JSON list"), "{text}");
    }
    let (_, text) = foreign.ask(RequestHeader { kind: 10, ..good }, foreign.blocks(), |_| {}).unwrap();
    assert!(text.contains("request kind must be 1 to 9, got 10"), "{text}");
}
