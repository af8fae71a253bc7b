//! Tests that scripted experts solve whatever can be solved from frames and memory.

use crate::support::player::Player;
use endless_gym::memory_gym;
use endless_gym::pool::{Autoreset, EnvReset, Experts, ExpertsError, PoolConfig, ResetRequest, Seeding};

/// Plays `num_envs` environments with seeds from 0 on, for `steps` steps or until all first episodes have ended.
/// Returns the info of each first episode that ended.
fn play(id: &str, num_envs: usize, steps: usize) -> Vec<Option<Vec<f64>>> {
    let spec = memory_gym().spec(id).unwrap();
    let config = PoolConfig::new(id, num_envs).features(true).seeding(Seeding::Continue { seed: Some(0) });
    let mut player = Player::started(&config);
    let mut experts = Experts::new(memory_gym(), spec.id, num_envs, config.autoreset).unwrap();
    let mut ended = vec![None; num_envs];
    let mut actions = vec![0; num_envs * spec.action_space.width()];
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
        let solved = ended.iter().filter(|info| info.as_deref() == Some(&[1.0; 3])).count();
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

/// Environments and episodes of each in the tests of a pool's experts.
const NUM_ENVS: usize = 3;
const EPISODES: usize = 3;

/// Returns and lengths of the first episodes of each environment.
type Episodes = [Vec<(f64, i32)>; NUM_ENVS];

fn config(id: &str, autoreset: Autoreset) -> PoolConfig {
    let seeding = Seeding::List(vec![5, 6, 7, 8, 9, 10]);
    PoolConfig::new(id, NUM_ENVS).features(true).frames(None).autoreset(autoreset).seeding(seeding)
}

/// More steps than these episodes take.
const MAX_STEPS: usize = 20_000;

/// Plays until every environment has ended [`EPISODES`] episodes.
fn play_pool(id: &str, autoreset: Autoreset) -> Episodes {
    let mut player = Player::started(&config(id, autoreset));
    let mut experts = Experts::new(memory_gym(), id, NUM_ENVS, autoreset).unwrap();
    let mut actions = vec![0; NUM_ENVS * player.pool.spec().action_space.width()];
    let mut episodes = Episodes::default();
    for step in 0.. {
        if episodes.iter().all(|episodes| episodes.len() >= EPISODES) {
            break;
        }
        assert!(step < MAX_STEPS, "{id}, {autoreset}: no more episodes end");
        experts.act(&player.batch(), &mut actions).unwrap();
        player.step(&actions);
        let batch = player.batch();
        let ended = [0, 1, 2].map(|env| batch.terminated()[env] == 1);
        for env in (0..NUM_ENVS).filter(|env| ended[*env]) {
            episodes[env].push((batch.episode_return()[env], batch.episode_length()[env]));
        }
        if autoreset == Autoreset::Disabled {
            let each = ended.map(|ended| if ended { EnvReset::Next } else { EnvReset::Keep });
            player.reset(ResetRequest::Each(&each));
        }
    }
    episodes.iter_mut().for_each(|episodes| episodes.truncate(EPISODES));
    episodes
}

/// The same episodes, each in an environment of its own, played by a new expert.
fn alone(id: &str) -> Episodes {
    std::array::from_fn(|env| {
        let episode = |number: usize| {
            let mut player = Player::new(&config(id, Autoreset::Disabled).num_envs(1).total_envs(1));
            player.reset(ResetRequest::Seed(5 + (number * NUM_ENVS + env) as u64 % 6));
            let mut expert = memory_gym().expert(id).unwrap();
            let mut action = vec![0; player.pool.spec().action_space.width()];
            while player.batch().terminated()[0] == 0 {
                expert.act(player.batch().features(), player.batch().vector_observation(), &mut action);
                player.step(&action);
            }
            (player.batch().episode_return()[0], player.batch().episode_length()[0])
        };
        (0..EPISODES).map(episode).collect()
    })
}

#[test]
fn every_episode_is_played_as_by_a_new_expert_in_every_mode() {
    for id in ["MortarMayhem-Grid-v0", "MortarMayhemB-Grid-v0", "MysteryPath-Grid-v0"] {
        let expected = alone(id);
        assert!(expected.iter().flatten().all(|(total, length)| *total > 0.0 && *length > 5), "{id}: {expected:?}");
        for mode in Autoreset::ALL {
            assert_eq!(play_pool(id, mode), expected, "{id}, {mode}");
        }
    }
}

#[test]
fn batches_and_actions_of_other_sizes_are_errors() {
    let id = "MortarMayhemB-Grid-v0";
    let act = |config: &PoolConfig, actions: &mut [i32]| {
        Experts::new(memory_gym(), id, NUM_ENVS, Autoreset::NextStep)?.act(&Player::new(config).batch(), actions)
    };
    let good = config(id, Autoreset::NextStep);
    let needed = NUM_ENVS * memory_gym().spec(id).unwrap().features.len();
    assert_eq!(act(&good, &mut [0; NUM_ENVS]), Ok(()));
    assert_eq!(act(&good, &mut [0; 2]), Err(ExpertsError::Actions { given: 2, needed: NUM_ENVS }));
    let error = |given| Err(ExpertsError::Features { given, needed, num_envs: NUM_ENVS });
    assert_eq!(act(&good.clone().features(false), &mut [0; NUM_ENVS]), error(0));
    assert_eq!(act(&good.num_envs(2).total_envs(2), &mut [0; NUM_ENVS]), error(needed / 3 * 2));
}
