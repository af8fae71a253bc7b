//! Compares with the original live: random seeds, options and actions must give no difference.
//!
//! The engine plays first, with experts that err now and then, so that episodes get far. The original then plays the
//! same actions, and a replay compares the two. `ENDLESS_ORIGINAL_PYTHON` names a Python 3.11 with memory-gym==1.0.2 and numpy<2. The
//! tests cannot run without it, so they are ignored by default; `cargo xtask test --all` sets up the original and runs
//! them. `ENDLESS_LIVE_STEPS`, which `cargo xtask live` sets, is the number of steps to compare for each id, with
//! different seeds in every run; without it, all runs are the same.

use crate::support::player::Player;
use crate::support::process::Answering;
use crate::support::recorded::{check_at_once, reference};
use endless_gym::envs::EnvSpec;
use endless_gym::memory_gym;
use endless_gym::pool::{Autoreset, PoolConfig, ResetOptions, ResetRequest};
use endless_gym::trace::{Trace, replay};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use serde_json::{Map, Value as Json, json};

/// Maximum number of steps played in an episode.
const MAX_STEPS: usize = 400;

/// One environment object that plays a few episodes.
#[derive(Clone, Debug)]
struct Case {
    options: Map<String, Json>,
    /// The first episode needs a seed, since unseeded ones always differ.
    first_seed: u64,
    seeds: Vec<Option<u64>>,
    /// The share of actions that are random instead of the expert's.
    error_rate: f64,
    action_seed: u64,
}

fn case(spec: &'static EnvSpec) -> impl Strategy<Value = Case> {
    let seeds = prop::collection::vec(prop::option::of(any::<u64>()), 1..4);
    let error_rate = prop_oneof![Just(0.0), Just(0.03), Just(0.3), Just(1.0)];
    let options = crate::support::recorded::options(spec).prop_map(|mut options| {
        NEWER.iter().for_each(|name| drop(options.remove(*name)));
        options
    });
    (options, any::<u64>(), seeds, error_rate, any::<u64>()).prop_map(
        |(options, first_seed, seeds, error_rate, action_seed)| Case {
            options,
            first_seed,
            seeds,
            error_rate,
            action_seed,
        },
    )
}

/// Plays a case in the engine. Returns the request that makes the original play the same.
fn play(spec: &'static EnvSpec, case: &Case) -> Json {
    let config = PoolConfig::new(spec.id, 1)
        .options(ResetOptions::Shared(case.options.clone()))
        .autoreset(Autoreset::Disabled)
        .features(true);
    let mut player = Player::new(&config);
    let mut random = SmallRng::seed_from_u64(case.action_seed);
    let branches = spec.action_space.branches();
    let mut episodes = Vec::new();
    for seed in std::iter::once(Some(case.first_seed)).chain(case.seeds.iter().copied()) {
        player.reset(seed.map_or(ResetRequest::All, ResetRequest::Seed));
        let mut expert = memory_gym().expert(spec.id).unwrap();
        let mut actions = Vec::new();
        for _ in 0..MAX_STEPS {
            let batch = player.batch();
            let mut action = vec![0; branches.len()];
            expert.act(batch.features(), batch.vector_observation(), &mut action);
            if random.random::<f64>() < case.error_rate {
                action.iter_mut().zip(branches).for_each(|(number, n)| *number = random.random_range(0..*n));
            }
            player.step(&action);
            actions.push(action);
            if player.batch().terminated()[0] == 1 {
                break;
            }
        }
        episodes.push(json!({"seed": seed, "actions": actions}));
    }
    json!({"env": spec.id, "options": case.options, "views": true, "episodes": episodes})
}

/// Reset parameters of version 1.0.3, which the original on PyPI, 1.0.2, lacks; the traces cover them.
const NEWER: [&str; 3] = ["reward_new_command_success", "reward_path_progress_dense", "coin_enabled"];

fn compare(id: &str) {
    let spec = memory_gym().spec(id).unwrap();
    let asked: Option<usize> = std::env::var("ENDLESS_LIVE_STEPS").ok().map(|text| text.parse().unwrap());
    let wanted = asked.unwrap_or(1500);
    let mut seeds = SmallRng::seed_from_u64(asked.map_or(0, |_| rand::random()));
    let original = Answering::start("ENDLESS_ORIGINAL_PYTHON", &reference().join("play.py"), &[]);
    let original = std::cell::RefCell::new(original);
    let (steps, raised) = (std::cell::Cell::new(0), std::cell::Cell::new(0));
    while steps.get() < wanted {
        let config = Config { cases: 4, failure_persistence: None, ..Config::default() };
        let random = TestRng::from_seed(RngAlgorithm::ChaCha, &seeds.random::<[u8; 32]>());
        TestRunner::new_with_rng(config, random)
            .run(&case(spec), |case| {
                let answer: Json = original.borrow_mut().ask(&play(spec, &case));
                if answer.get("error").is_some() {
                    raised.set(raised.get() + 1);
                    return Ok(());
                }
                let trace: Trace = serde_json::from_value(answer).unwrap();
                let replay = replay(memory_gym(), &trace).unwrap();
                prop_assert_eq!(replay.first, None);
                steps.set(steps.get() + replay.steps);
                Ok(())
            })
            .unwrap();
        assert!(raised.get() < 20 + steps.get() / 50, "{id}: the original raises too often to compare with");
    }
    println!(
        "{id}: {} steps without a difference, {} option sets at which the original raises",
        steps.get(),
        raised.get()
    );
}

#[test]
#[ignore = "needs the original, in the Python that ENDLESS_ORIGINAL_PYTHON names: run `cargo xtask test --all`"]
fn every_id_plays_as_the_original() {
    check_at_once(memory_gym().specs(), |spec| compare(spec.id));
}
