//! Reset parameters of next episodes, and seed and options of running episodes, in a pool.

use crate::support::player::Player;
use endless_gym::pool::{Autoreset, EnvReset, NextOptions, PoolConfig, PoolError, ResetRequest, Seeding};
use serde_json::{Map, Value as Json, json};

/// With an agent that does nothing, an episode ends within a few dozen steps.
const ID: &str = "MortarMayhem-Grid-v0";

fn options(value: &Json) -> Map<String, Json> {
    value.as_object().unwrap().clone()
}

fn next(value: &Json, envs: &[usize]) -> NextOptions {
    NextOptions { options: options(value), envs: envs.to_vec() }
}

/// Plays one step without moving, and returns the environments whose episodes ended.
fn step(player: &mut Player) -> Vec<usize> {
    player.step_all(0);
    let ended = player.batch().terminated();
    (0..ended.len()).filter(|env| ended[*env] != 0).collect()
}

fn running(player: &Player, env: usize) -> Json {
    player.pool.running_episode(env).unwrap().options.into()
}

fn config(num_envs: usize, autoreset: Autoreset) -> PoolConfig {
    PoolConfig::new(ID, num_envs).seeding(Seeding::Continue { seed: Some(3) }).autoreset(autoreset)
}

#[test]
fn next_options_apply_from_the_next_episode_on_in_every_autoreset_mode() {
    for autoreset in Autoreset::ALL {
        let mut player = Player::new(&config(3, autoreset));
        let (three, one) = (json!({"command_count": [3]}), json!({"command_count": [1]}));
        // Before the first episodes.
        player.pool.set_options(&[next(&three, &[0, 2])]).unwrap();
        player.reset(ResetRequest::All);
        assert_eq!([0, 1, 2].map(|env| running(&player, env)), [three.clone(), json!({}), three.clone()]);
        step(&mut player);
        player.pool.set_options(&[next(&one, &[2]), next(&three, &[1])]).unwrap();
        let mut ended = [false; 3];
        for _ in 0..200 {
            let expected = [three.clone(), json!({}), three.clone()];
            for env in 0..3 {
                assert!(ended[env] || running(&player, env) == expected[env], "the running episode does not change");
            }
            let before = ended;
            step(&mut player).into_iter().for_each(|env| ended[env] = true);
            let began = match autoreset {
                Autoreset::NextStep => before,
                Autoreset::SameStep => ended,
                Autoreset::Disabled => [false; 3],
            };
            let later = [three.clone(), three.clone(), one.clone()];
            for env in 0..3 {
                if began[env] {
                    assert_eq!(running(&player, env), later[env], "{autoreset}");
                }
            }
            if before == [true; 3] {
                break;
            }
        }
        assert_eq!(ended, [true; 3]);
        player.reset(ResetRequest::Each(&[EnvReset::Keep, EnvReset::Keep, EnvReset::Next]));
        assert_eq!(running(&player, 2), one);
        // A reset with options replaces them.
        player.pool.set_options(&[next(&three, &[2])]).unwrap();
        let two = json!({"command_count": [2]});
        player.pool.reset_with(ResetRequest::All, Some(&options(&two)), &mut player.blocks).unwrap();
        assert_eq!([0, 1, 2].map(|env| running(&player, env)), [two.clone(), two.clone(), two]);
    }
}

#[test]
fn an_episode_with_next_options_equals_that_of_a_pool_created_with_them() {
    let wanted = json!({"command_count": [2], "arena_size": 4});
    let mut made =
        Player::new(&config(2, Autoreset::NextStep).options(endless_gym::pool::ResetOptions::Shared(options(&wanted))));
    let mut set = Player::new(&config(2, Autoreset::NextStep));
    set.pool.set_options(&[next(&wanted, &[0, 1])]).unwrap();
    for player in [&mut made, &mut set] {
        player.reset(ResetRequest::All);
    }
    for _ in 0..300 {
        assert!(made.bytes() == set.bytes());
        step(&mut made);
        step(&mut set);
    }
}

#[test]
fn next_options_survive_snapshots_and_checkpoints() {
    let one = json!({"command_count": [1], "arena_size": 6});
    let mut player = Player::new(&config(2, Autoreset::NextStep));
    player.reset(ResetRequest::All);
    step(&mut player);
    player.pool.set_options(&[next(&one, &[0])]).unwrap();
    let snapshot = player.pool.snapshot(0).unwrap();
    let saved = player.pool.save().unwrap().unwrap();

    let mut restored = Player::new(&config(2, Autoreset::NextStep));
    restored.reset(ResetRequest::Seed(90));
    restored.pool.restore(0, &snapshot).unwrap();
    assert_eq!(restored.pool.snapshot(0).unwrap(), snapshot);
    assert_eq!(restored.pool.running_episode(0).unwrap(), player.pool.running_episode(0).unwrap());
    let mut resumed = Player::new(&config(2, Autoreset::NextStep));
    resumed.pool.resume(&saved).unwrap();
    for player in [&mut player, &mut resumed] {
        player.observe();
    }
    for _ in 0..200 {
        assert!(player.bytes() == resumed.bytes());
        for player in [&mut player, &mut resumed, &mut restored] {
            step(player);
        }
    }
    for player in [&player, &resumed, &restored] {
        assert_eq!(running(player, 0), one);
        assert_eq!(running(player, 1), json!({}));
    }
}

#[test]
fn refused_next_options_change_nothing() {
    let mut player = Player::new(&config(2, Autoreset::NextStep));
    assert!(matches!(player.pool.running_episode(0), Err(PoolError::NotReset)));
    player.reset(ResetRequest::All);
    let before = player.pool.save().unwrap();
    let good = json!({"command_count": [1]});
    let refused = player.pool.set_options(&[next(&good, &[0]), next(&json!({"command_count": "x"}), &[1])]);
    assert!(matches!(refused, Err(PoolError::Parameters(_))));
    let refused = player.pool.set_options(&[next(&good, &[0, 2])]);
    assert!(matches!(refused, Err(PoolError::NoSuchEnv { given: 2, num_envs: 2 })));
    assert!(matches!(player.pool.running_episode(2), Err(PoolError::NoSuchEnv { given: 2, num_envs: 2 })));
    assert_eq!(player.pool.save().unwrap(), before);
}

#[test]
fn a_running_episode_reports_its_seed() {
    let seeds = |seeding: Seeding| {
        let mut player = Player::new(&config(2, Autoreset::SameStep).seeding(seeding));
        player.reset(ResetRequest::All);
        let mut seen = vec![player.pool.running_episode(0).unwrap().seed];
        while seen.len() < 4 {
            if step(&mut player).contains(&0) {
                seen.push(player.pool.running_episode(0).unwrap().seed);
            }
        }
        player.reset(ResetRequest::Seed(77));
        assert_eq!(player.pool.running_episode(1).unwrap().seed, Some(78));
        seen
    };
    assert_eq!(seeds(Seeding::Continue { seed: Some(5) }), [Some(5), None, None, None]);
    assert_eq!(seeds(Seeding::Continue { seed: None }), [None; 4]);
    assert_eq!(seeds(Seeding::List(vec![1, 2, 3])), [Some(1), Some(3), Some(2), Some(1)]);
    for seed in seeds(Seeding::Range { start: 10, end: 10_000, step: 3, seed: Some(1) }) {
        assert!(seed.is_some_and(|seed| (10..10_000).contains(&seed) && (seed - 10).is_multiple_of(3)));
    }
}
