//! `PoolConfig::independent_episodes`: an episode depends only on its seed and its reset parameters.

use crate::support::player::Player;
use endless_gym::envs::EnvSpec;
use endless_gym::memory_gym;
use endless_gym::pool::{Autoreset, OptionMap, PoolConfig, ResetOptions, ResetRequest, Seeding, SnapshotError};
use proptest::prelude::*;
use rand::SeedableRng;
use rand::rngs::SmallRng;
use serde_json::json;

fn reset(player: &mut Player, seed: u64, options: &OptionMap) {
    player.pool.reset_with(ResetRequest::Seed(seed), Some(options), &mut player.blocks).unwrap();
}

/// Plays random actions.
fn play(player: &mut Player, steps: usize, random: &mut SmallRng) {
    (0..steps).for_each(|_| player.step_at_random(random));
}

fn ground_truth_view(player: &mut Player) -> Vec<u8> {
    player.pool.ground_truth_view(0).unwrap().pixels
}

/// The batches of the seeded episode and of later ones, and the final state.
fn episode(player: &mut Player, seed: u64, options: &OptionMap, steps: usize) -> Vec<Vec<u8>> {
    reset(player, seed, options);
    let mut played = vec![player.bytes().to_vec(), ground_truth_view(player)];
    let mut random = SmallRng::seed_from_u64(seed);
    for _ in 0..steps {
        player.step_at_random(&mut random);
        played.push(player.bytes().to_vec());
    }
    played.extend([ground_truth_view(player), player.pool.snapshot(0).unwrap()]);
    played
}

fn config(spec: &EnvSpec, independent_episodes: bool) -> PoolConfig {
    PoolConfig::new(spec.id, 1).autoreset(Autoreset::NextStep).independent_episodes(independent_episodes).features(true)
}

fn with_options() -> impl Strategy<Value = (&'static EnvSpec, OptionMap, OptionMap)> {
    prop::sample::select(memory_gym().specs().collect::<Vec<_>>()).prop_flat_map(|spec| {
        (Just(spec), crate::support::recorded::options(spec), crate::support::recorded::options(spec))
    })
}

proptest! {
    #![proptest_config(crate::support::recorded::property_cases(150))]

    #[test]
    fn a_used_environment_plays_the_same_as_a_new_one(
        (spec, earlier, options) in with_options(), seeds in any::<[u32; 2]>(), steps in 0..150_usize,
    ) {
        let [seed, actions] = seeds.map(u64::from);
        let [mut fresh, mut used] = [(); 2].map(|()| Player::new(&config(spec, true)));
        reset(&mut used, seed ^ 1, &earlier);
        play(&mut used, steps, &mut SmallRng::seed_from_u64(actions));
        let [fresh, used] = [&mut fresh, &mut used].map(|player| episode(player, seed, &options, 60));
        prop_assert!(fresh == used, "{}", spec.id);
    }
}

/// Ids and options with which an episode of the original shows leftovers of an earlier one.
fn leaks() -> [(&'static str, OptionMap); 3] {
    let options = |value: serde_json::Value| value.as_object().unwrap().clone();
    [
        ("Endless-MortarMayhem-v0", options(json!({"agent_scale": 0.4}))),
        ("SearingSpotlights-v0", options(json!({"hide_chessboard": true}))),
        ("Endless-SearingSpotlights-v0", options(json!({"black_background": true}))),
    ]
}

#[test]
fn only_with_the_option_new_and_used_environments_play_the_same() {
    for (id, earlier) in leaks() {
        let spec = memory_gym().spec(id).unwrap();
        for independent in [false, true] {
            let [mut fresh, mut used] = [(); 2].map(|()| Player::new(&config(spec, independent)));
            reset(&mut used, 7, &earlier);
            play(&mut used, 40, &mut SmallRng::seed_from_u64(0));
            let [fresh, used] = [&mut fresh, &mut used].map(|player| episode(player, 1, &OptionMap::new(), 40));
            // Compare the frames, without the views and the state.
            let same = fresh[2..42] == used[2..42] && fresh[0] == used[0];
            assert_eq!(same, independent, "{id}");
        }
    }
}

/// The first observations of the episodes of one environment that plays these actions.
fn starts(config: &PoolConfig, actions: u64, seed: Option<u64>) -> Vec<Vec<u8>> {
    let (mut player, mut random) = (Player::new(config), SmallRng::seed_from_u64(actions));
    player.reset(seed.map_or(ResetRequest::All, ResetRequest::Seed));
    let mut starts = vec![];
    for _ in 0..10_000 {
        let batch = player.batch();
        if batch.episode_length()[0] == 0 {
            starts.push([batch.observation(), bytemuck::cast_slice(batch.features())].concat());
        }
        if starts.len() == 4 {
            return starts;
        }
        player.step_at_random(&mut random);
    }
    panic!("{} episodes have ended", starts.len());
}

fn short_episodes(spec: &EnvSpec) -> ResetOptions {
    let limit = spec.parameters.iter().find(|parameter| parameter.name == "max_steps");
    ResetOptions::Shared(limit.map(|limit| (limit.name.to_owned(), json!(40))).into_iter().collect())
}

#[test]
fn later_episodes_depend_on_the_seed_and_not_on_earlier_actions() {
    for spec in memory_gym().specs() {
        let seeded = |independent, seed| {
            config(spec, independent).seeding(Seeding::Continue { seed }).options(short_episodes(spec))
        };
        let all = starts(&seeded(true, Some(5)), 1, None);
        assert!(all[1..].iter().any(|start| *start != all[0]), "{}: not the same again", spec.id);
        assert!(all == starts(&seeded(true, Some(5)), 2, None), "{}: other actions", spec.id);
        assert!(all == starts(&seeded(true, None), 3, Some(5)), "{}: the seed of a reset", spec.id);
        // Some ids have few different first frames, so that different seeds may show the same ones.
        assert!((0..32).any(|_| all != starts(&seeded(true, None), 1, None)), "{}: entropy", spec.id);
        // The first episode is the original's.
        assert!(all[0] == starts(&seeded(false, Some(5)), 1, None)[0], "{}: the seed's own episode", spec.id);
    }
}

#[test]
fn restored_snapshots_continue_with_the_same_seeds() -> Result<(), SnapshotError> {
    let spec = memory_gym().spec("MortarMayhem-Grid-v0").unwrap();
    let mut first = Player::new(&config(spec, true));
    reset(&mut first, 3, &OptionMap::new());
    let snapshot = first.pool.snapshot(0)?;
    for independent in [true, false] {
        let mut second = Player::new(&config(spec, independent));
        reset(&mut second, 4, &OptionMap::new());
        let ends = |player: &mut Player| {
            player.pool.restore(0, &snapshot)?;
            play(player, 300, &mut SmallRng::seed_from_u64(9));
            Ok::<_, SnapshotError>(player.bytes().to_vec())
        };
        assert_eq!(ends(&mut first)? == ends(&mut second)?, independent);
    }
    Ok(())
}
