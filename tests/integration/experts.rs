//! Tests that scripted experts solve whatever can be solved from frames and memory.

use crate::support::player::Player;
use endless_gym::memory_gym;
use endless_gym::pool::{Experts, PoolConfig, Seeding};

/// Plays `num_envs` environments with seeds from 0 on, for `steps` steps or until all first episodes have ended.
/// Returns the info of each first episode that ended.
fn play(id: &str, num_envs: usize, steps: usize) -> Vec<Option<Vec<f64>>> {
    let spec = memory_gym().spec(id).unwrap();
    let config =
        PoolConfig { features: true, seeding: Seeding::Continue { seed: Some(0) }, ..PoolConfig::new(id, num_envs) };
    let mut player = Player::started(&config);
    let mut experts = Experts::new(memory_gym(), spec.id, num_envs, config.autoreset).unwrap();
    let mut ended = vec![None; num_envs];
    let mut actions = vec![0; num_envs * spec.action_space.branches().len()];
    for _ in 0..steps {
        experts.act(&player.batch(), &mut actions).unwrap();
        player.step(&actions);
        let batch = player.batch();
        for (env, ended) in ended.iter_mut().enumerate().filter(|(env, _)| batch.terminated()[*env] == 1) {
            let info = &batch.info()[env * spec.info.len()..][..spec.info.len()];
            ended.get_or_insert_with(|| info.to_vec());
        }
        if ended.iter().all(Option::is_some) {
            break;
        }
    }
    ended
}

#[test]
fn finite_mortar_mayhem_is_solved() {
    // The length of a solved game with default options, for each id.
    for (id, length) in [
        ("MortarMayhem-v0", 274),
        ("MortarMayhem-Grid-v0", 118),
        ("MortarMayhemB-v0", 235),
        ("MortarMayhemB-Grid-v0", 79),
    ] {
        let ended = play(id, 100, length);
        let solved = ended.iter().filter(|info| info.as_deref() == Some(&[1.0, 1.0])).count();
        assert!(solved >= 99, "{id}: {solved} of 100 solved within {length} steps");
        let early = play(id, 100, length - 1);
        assert!(early.iter().all(Option::is_none), "{id}: no game is over after {} steps", length - 1);
    }
}

#[test]
fn endless_mortar_mayhem_goes_on() {
    let ended = play("Endless-MortarMayhem-v0", 8, 10_000);
    assert!(ended.iter().all(Option::is_none), "{ended:?}");
}

/// How many of the first episodes succeed within `steps` steps.
fn solved(id: &str, num_envs: usize, steps: usize) -> usize {
    let success = memory_gym().spec(id).unwrap().info.iter().position(|column| column.name == "success").unwrap();
    play(id, num_envs, steps).iter().flatten().filter(|info| info[success] == 1.0).count()
}

#[test]
fn finite_mystery_path_is_solved() {
    for (id, limit) in [("MysteryPath-v0", 512), ("MysteryPath-Grid-v0", 128)] {
        let solved = solved(id, 100, limit);
        assert!(solved >= 99, "{id}: {solved} of 100 solved");
    }
}

/// The agent of this id cannot walk left, so it fails where the path turns left.
#[test]
fn endless_mystery_path_continues() {
    let ended = play("Endless-MysteryPath-v0", 30, 10_000).iter().flatten().count();
    assert!(ended <= 1, "{ended} of 30 ended");
}

#[test]
#[ignore = "slow"]
fn finite_searing_spotlights_is_solved() {
    let solved = solved("SearingSpotlights-v0", 100, 1024);
    assert!(solved >= 99, "{solved} of 100 solved");
}

#[test]
fn endless_searing_spotlights_lasts() {
    let ended = play("Endless-SearingSpotlights-v0", 4, 1000);
    assert!(ended.iter().all(Option::is_none), "{ended:?}");
}
