//! Tests that a custom environment, the T-maze of the examples, has all features of a built-in one.

#[path = "../../docs/examples/t_maze/task.rs"]
#[allow(dead_code)]
mod t_maze;

use endless_gym::memory_gym;
use endless_gym::pool::{Autoreset, Pool, PoolConfig, Registry, RegistryError, ResetOptions, ResetRequest, Threads};
use serde_json::json;

use crate::support::player::Player;
use t_maze::TMaze;

const ID: &str = "TMaze-v0";
const NUM_ENVS: usize = 6;
const AHEAD: i32 = 2;

fn registry() -> Registry {
    Registry::new().with::<TMaze>().unwrap()
}

/// Short mazes with features; the pool compares frames with frames that are drawn in full.
fn config(autoreset: Autoreset) -> PoolConfig {
    let options = json!({"length": 3, "max_steps": 8}).as_object().unwrap().clone();
    let options = ResetOptions::Shared(options);
    PoolConfig::new(ID, NUM_ENVS).options(options).autoreset(autoreset).features(true).check_drawing(true)
}

fn player(config: &PoolConfig) -> Player {
    Player::in_registry(&registry(), config, 1)
}

/// Walks to the junction and turns to the side of the cue or, if `remembers` is false, to the other side. Returns the
/// rewards.
fn play(autoreset: Autoreset, remembers: bool) -> Vec<f64> {
    let mut player = player(&config(autoreset));
    player.reset(ResetRequest::Seed(1));
    let cues: Vec<i32> = player.batch().features().chunks_exact(2).map(|row| (row[0] == 1.0).into()).collect();
    assert!(cues.contains(&0) && cues.contains(&1));
    (0..3).for_each(|_| player.step_all(AHEAD));
    player.step(&cues.iter().map(|cue| if remembers { *cue } else { 1 - cue }).collect::<Vec<_>>());
    let batch = player.batch();
    assert_eq!((batch.terminated(), batch.truncated()), ([1; NUM_ENVS].as_slice(), [0; NUM_ENVS].as_slice()));
    assert_eq!(batch.info(), [f64::from(u8::from(remembers)); NUM_ENVS]);
    batch.reward().to_vec()
}

#[test]
fn every_autoreset_mode_plays_a_task() {
    for autoreset in Autoreset::ALL {
        assert_eq!(play(autoreset, true), [1.0; NUM_ENVS]);
        assert_eq!(play(autoreset, false), [-1.0; NUM_ENVS]);
    }
}

#[test]
fn truncation_ends_an_episode_and_differs_from_termination() {
    for autoreset in Autoreset::ALL {
        let mut player = player(&config(autoreset));
        player.reset(ResetRequest::All);
        for step in 1..=8 {
            player.step_all(AHEAD);
            assert_eq!(player.batch().truncated(), [u8::from(step == 8); NUM_ENVS], "{autoreset}, step {step}");
            assert_eq!(player.batch().terminated(), [0; NUM_ENVS]);
        }
        let junction = player.batch().features()[1];
        assert_eq!(junction == 0.0, autoreset == Autoreset::SameStep, "the next episode has started in the same step");
    }
}

#[test]
fn options_are_checked_and_ids_are_unique() {
    let given = json!({"length": 81}).as_object().unwrap().clone();
    let config = PoolConfig::new(ID, 1).options(ResetOptions::Shared(given));
    let error = Pool::new(&registry(), &config, &Threads::new(1).unwrap()).map(drop).unwrap_err();
    assert_eq!(error.to_string(), "reset parameter `length` must be an integer, 1 to 80, got 81");
    let error = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).map(drop).unwrap_err();
    assert!(error.to_string().starts_with("no environment `TMaze-v0`; there are MortarMayhem-v0, "), "{error}");
    let twice = registry().with::<TMaze>().map(drop);
    assert_eq!(twice, Err(RegistryError::Duplicate { id: ID }));
    assert_eq!(memory_gym().clone().with::<TMaze>().unwrap().specs().count(), 11);
}
