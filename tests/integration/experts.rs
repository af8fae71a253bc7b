//! Scripted experts solve what can be solved, from what a frame shows and what they remember.

use endless_gym::batch::{Batch, zeroed};
use endless_gym::envs::{self, Expert};
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};

/// Plays `num_envs` environments with the seeds from 0 on, for `steps` steps or until all first episodes have ended. The info
/// of each first episode that ended.
fn play(id: &str, num_envs: usize, steps: usize) -> Vec<Option<Vec<f64>>> {
    let spec = envs::spec(id).unwrap();
    let config =
        PoolConfig { features: true, seeding: Seeding::Continue { seed: Some(0) }, ..PoolConfig::new(id, num_envs) };
    let mut pool = Pool::new(&config, &Threads::new(1).unwrap()).unwrap();
    let mut blocks = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::All, &mut blocks).unwrap();
    let mut experts: Vec<Box<dyn Expert>> = (0..num_envs).map(|_| envs::expert(spec)).collect();
    let mut ended = vec![None; num_envs];
    let branches = spec.action_space.branches().len();
    let mut actions = vec![0; num_envs * branches];
    for _ in 0..steps {
        let batch = Batch::new(pool.layout(), &blocks);
        let (features, vectors) = (batch.features(), batch.vector_observation());
        for (env, (expert, action)) in experts.iter_mut().zip(actions.chunks_exact_mut(branches)).enumerate() {
            let features = &features[env * spec.features.len()..][..spec.features.len()];
            let vector = &vectors[env * spec.vector_observation..][..spec.vector_observation];
            expert.act(features, vector, action);
        }
        pool.step(&actions, &mut blocks).unwrap();
        let batch = Batch::new(pool.layout(), &blocks);
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

/// How many of the first episodes with these seeds end with success, each within its step limit.
fn solved(id: &str, num_envs: usize, steps: usize) -> usize {
    let success = envs::spec(id).unwrap().info.iter().position(|column| column.name == "success").unwrap();
    play(id, num_envs, steps).iter().flatten().filter(|info| info[success] == 1.0).count()
}

#[test]
fn finite_mystery_path_is_solved() {
    for (id, limit) in [("MysteryPath-v0", 512), ("MysteryPath-Grid-v0", 128)] {
        let solved = solved(id, 100, limit);
        assert!(solved >= 99, "{id}: {solved} of 100 solved");
    }
}

/// Where the way turns left, no agent can continue: that of this id cannot walk there.
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
