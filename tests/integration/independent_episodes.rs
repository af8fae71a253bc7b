//! `PoolConfig::independent_episodes`: an episode depends on its seed and its reset parameters alone.

use endless_gym::batch::{Batch, Block, zeroed};
use endless_gym::envs::view::VIEW_BYTES;
use endless_gym::envs::{self, EnvSpec};
use endless_gym::pool::{
    Autoreset, OptionMap, Pool, PoolConfig, ResetOptions, ResetRequest, Seeding, SnapshotError, Threads,
};
use proptest::prelude::*;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use serde_json::json;

struct Player {
    pool: Pool,
    blocks: Vec<Block>,
    actions: SmallRng,
}

impl Player {
    /// One environment, which has not been reset; `actions` seeds what it plays.
    fn new(config: &PoolConfig, actions: u64) -> Self {
        let pool = Pool::new(config, &Threads::new(1).unwrap()).unwrap();
        let blocks = zeroed(pool.layout().blocks());
        Player { pool, blocks, actions: SmallRng::seed_from_u64(actions) }
    }

    fn reset(&mut self, seed: u64, options: &OptionMap) {
        self.pool.reset_with(ResetRequest::Seed(seed), Some(options), &mut self.blocks).unwrap();
    }

    fn step(&mut self) {
        let branches = self.pool.spec().action_space.branches();
        let action: Vec<i32> = branches.iter().map(|n| self.actions.random_range(0..*n)).collect();
        self.pool.step(&action, &mut self.blocks).unwrap();
    }

    /// Every byte of the batch.
    fn bytes(&self) -> Vec<u8> {
        Batch::new(self.pool.layout(), &self.blocks).bytes().to_vec()
    }

    fn ground_truth_view(&mut self) -> Vec<u8> {
        let mut view = vec![0; VIEW_BYTES];
        self.pool.ground_truth_view(0, &mut view).unwrap();
        view
    }

    /// The batches of the seeded episode and of those that follow, then the state at the end.
    fn episode(&mut self, seed: u64, options: &OptionMap, steps: usize) -> Vec<Vec<u8>> {
        self.reset(seed, options);
        let mut played = vec![self.bytes(), self.ground_truth_view()];
        self.actions = SmallRng::seed_from_u64(seed);
        for _ in 0..steps {
            self.step();
            played.push(self.bytes());
        }
        played.extend([self.ground_truth_view(), self.pool.snapshot(0).unwrap()]);
        played
    }
}

fn config(spec: &EnvSpec, independent_episodes: bool) -> PoolConfig {
    PoolConfig { autoreset: Autoreset::NextStep, independent_episodes, features: true, ..PoolConfig::new(spec.id, 1) }
}

fn with_options() -> impl Strategy<Value = (&'static EnvSpec, OptionMap, OptionMap)> {
    prop::sample::select(envs::specs().collect::<Vec<_>>()).prop_flat_map(|spec| {
        (Just(spec), crate::support::recorded::options(spec), crate::support::recorded::options(spec))
    })
}

proptest! {
    #![proptest_config(crate::support::recorded::property_cases(150))]

    #[test]
    fn a_used_environment_plays_what_a_new_one_does(
        (spec, earlier, options) in with_options(), seeds in any::<[u32; 2]>(), steps in 0..150_usize,
    ) {
        let [seed, actions] = seeds.map(u64::from);
        let mut fresh = Player::new(&config(spec, true), 0);
        let mut used = Player::new(&config(spec, true), actions);
        used.reset(seed ^ 1, &earlier);
        (0..steps).for_each(|_| used.step());
        prop_assert!(used.episode(seed, &options, 60) == fresh.episode(seed, &options, 60), "{}", spec.id);
    }
}

/// Options and an id for which an episode of the original shows what an earlier one left.
fn leaks() -> [(&'static str, OptionMap); 3] {
    let options = |value: serde_json::Value| value.as_object().unwrap().clone();
    [
        ("Endless-MortarMayhem-v0", options(json!({"agent_scale": 0.4}))),
        ("SearingSpotlights-v0", options(json!({"hide_chessboard": true}))),
        ("Endless-SearingSpotlights-v0", options(json!({"black_background": true}))),
    ]
}

#[test]
fn only_with_the_option_a_new_environment_plays_the_same() {
    for (id, earlier) in leaks() {
        let spec = envs::spec(id).unwrap();
        for independent in [false, true] {
            let mut fresh = Player::new(&config(spec, independent), 0);
            let mut used = Player::new(&config(spec, independent), 0);
            used.reset(7, &earlier);
            (0..40).for_each(|_| used.step());
            let plain = OptionMap::new();
            used.reset(1, &plain);
            fresh.reset(1, &plain);
            let mut same = used.bytes() == fresh.bytes();
            for player in [&mut used, &mut fresh] {
                player.actions = SmallRng::seed_from_u64(1);
            }
            for _ in 0..40 {
                used.step();
                fresh.step();
                same &= used.bytes() == fresh.bytes();
            }
            assert_eq!(same, independent, "{id}");
        }
    }
}

/// The first observations of the episodes of one environment that plays these actions.
fn starts(config: &PoolConfig, actions: u64, seed: Option<u64>) -> Vec<Vec<u8>> {
    let mut player = Player::new(config, actions);
    let request = seed.map_or(ResetRequest::All, ResetRequest::Seed);
    player.pool.reset(request, &mut player.blocks).unwrap();
    let mut starts = vec![];
    for _ in 0..10_000 {
        let batch = Batch::new(player.pool.layout(), &player.blocks);
        if batch.episode_length()[0] == 0 {
            starts.push([batch.observation(), bytemuck::cast_slice(batch.features())].concat());
        }
        if starts.len() == 4 {
            return starts;
        }
        player.step();
    }
    panic!("{} episodes have ended", starts.len());
}

fn short_episodes(spec: &EnvSpec) -> ResetOptions {
    let limit = spec.parameters.iter().find(|parameter| parameter.name == "max_steps");
    ResetOptions::Shared(limit.map(|limit| (limit.name.to_owned(), json!(40))).into_iter().collect())
}

#[test]
fn later_episodes_depend_on_the_seed_and_not_on_what_was_played() {
    for spec in envs::specs() {
        let seeded = |independent, seed| PoolConfig {
            seeding: Seeding::Continue { seed },
            options: short_episodes(spec),
            ..config(spec, independent)
        };
        let all = starts(&seeded(true, Some(5)), 1, None);
        assert!(all[1..].iter().any(|start| *start != all[0]), "{}: not the same again", spec.id);
        assert!(all == starts(&seeded(true, Some(5)), 2, None), "{}: other actions", spec.id);
        assert!(all == starts(&seeded(true, None), 3, Some(5)), "{}: the seed of a reset", spec.id);
        // Some ids have few first frames, so that different seeds may show the same ones.
        assert!((0..32).any(|_| all != starts(&seeded(true, None), 1, None)), "{}: entropy", spec.id);
        // The first episode is the one of the original.
        assert!(all[0] == starts(&seeded(false, Some(5)), 1, None)[0], "{}: the seed's own episode", spec.id);
    }
}

#[test]
fn snapshots_go_on_with_the_same_seeds() -> Result<(), SnapshotError> {
    let spec = envs::spec("MortarMayhem-Grid-v0").unwrap();
    let mut first = Player::new(&config(spec, true), 1);
    first.reset(3, &OptionMap::new());
    let snapshot = first.pool.snapshot(0)?;
    for independent in [true, false] {
        let mut second = Player::new(&config(spec, independent), 1);
        second.reset(4, &OptionMap::new());
        second.pool.restore(0, &snapshot)?;
        let ends = |player: &mut Player| {
            player.actions = SmallRng::seed_from_u64(9);
            (0..300).for_each(|_| player.step());
            player.bytes()
        };
        first.pool.restore(0, &snapshot)?;
        assert_eq!(ends(&mut first) == ends(&mut second), independent);
    }
    Ok(())
}
