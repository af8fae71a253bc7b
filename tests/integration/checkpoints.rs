//! Environments that are saved and resumed continue bit for bit, whatever their id, options, format, auto-reset and seeding.

use endless_gym::batch::{Batch, Frames, zeroed};
use endless_gym::envs::{EnvSpec, specs};
use endless_gym::pool::{
    Autoreset, Pool, PoolConfig, ResetOptions, ResetRequest, ResumeError, Seeding, SnapshotError, Threads,
};
use proptest::prelude::*;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

const NUM_ENVS: usize = 3;

fn config(spec: &'static EnvSpec) -> impl Strategy<Value = PoolConfig> {
    let options = prop::collection::vec(crate::support::recorded::options(spec), NUM_ENVS).prop_map(ResetOptions::Each);
    let seeding = prop_oneof![
        Just(Seeding::Continue { seed: None }),
        Just(Seeding::Continue { seed: Some(5) }),
        Just(Seeding::Range { start: 0, end: 100_000, step: 3, seed: Some(3) }),
        Just(Seeding::List(vec![9, 3, 27, 4])),
    ];
    let autoreset = prop::sample::select(Autoreset::ALL.to_vec());
    let frames = (crate::support::recorded::pixel_format(), prop::sample::select(vec![1, 1, 2, 4]));
    let frames = prop::option::weighted(0.8, frames.prop_map(|(format, stack)| Frames { format, stack }));
    (options, seeding, autoreset, frames, any::<bool>()).prop_map(|(options, seeding, autoreset, frames, features)| {
        PoolConfig {
            options,
            seeding,
            autoreset,
            frames,
            features,
            final_observation: true,
            check_drawing: true,
            ..PoolConfig::new(spec.id, NUM_ENVS)
        }
    })
}

/// A pool and a successor that resumes what it saved after `before` steps play the same `after` steps.
fn compare(config: &PoolConfig, before: usize, after: usize) {
    let threads = Threads::new(1).unwrap();
    let mut pool = Pool::new(config, &threads).unwrap();
    let mut blocks = zeroed(pool.layout().blocks());
    assert_eq!(pool.save().unwrap(), None);
    pool.reset(ResetRequest::All, &mut blocks).unwrap();
    let mut random = SmallRng::seed_from_u64(1);
    let branches = pool.spec().action_space.branches();
    let mut actions =
        || -> Vec<i32> { (0..NUM_ENVS).flat_map(|_| branches).map(|n| random.random_range(0..*n)).collect() };
    for _ in 0..before {
        pool.step(&actions(), &mut blocks).unwrap();
    }
    let saved = pool.save().unwrap().unwrap();
    let mut successor = Pool::new(config, &threads).unwrap();
    successor.resume(&saved).unwrap();
    assert_eq!(successor.save().unwrap().unwrap(), saved);
    // Final observations are written at the end of an episode only: both start with a new buffer.
    let mut others = zeroed(pool.layout().blocks());
    blocks.clone_from(&others);
    pool.observe(&mut blocks).unwrap();
    successor.observe(&mut others).unwrap();
    let bytes = |pool: &Pool, blocks: &[_]| Batch::new(pool.layout(), blocks).bytes().to_vec();
    assert!(bytes(&pool, &blocks) == bytes(&successor, &others), "after {before} steps");
    for step in 0..after {
        let actions = actions();
        pool.step(&actions, &mut blocks).unwrap();
        successor.step(&actions, &mut others).unwrap();
        assert!(bytes(&pool, &blocks) == bytes(&successor, &others), "step {step} after {before}");
    }
}

#[test]
fn resumed_environments_continue_identically() {
    for spec in specs() {
        let mut runner = proptest::test_runner::TestRunner::new(crate::support::recorded::property_cases(4));
        let run = runner.run(&(config(spec), 0..90usize), |(config, before)| {
            compare(&config, before, 60);
            Ok(())
        });
        run.unwrap_or_else(|error| panic!("{}: {error}", spec.id));
    }
}

#[test]
fn a_pending_reset_of_next_step_autoreset_is_part_of_the_state() {
    // Random agents fail within some steps, so that a save hits every phase of an episode's end.
    for autoreset in Autoreset::ALL {
        let config = PoolConfig {
            autoreset,
            seeding: Seeding::Range { start: 0, end: 50, step: 1, seed: Some(1) },
            ..PoolConfig::new("Endless-MortarMayhem-v0", NUM_ENVS)
        };
        (100..120).for_each(|before| compare(&config, before, 3));
    }
}

#[test]
fn what_does_not_fit_is_an_error() {
    let threads = Threads::new(1).unwrap();
    let frames = |stack| Some(Frames { stack, ..Frames::default() });
    let pool = |num_envs, frames| {
        Pool::new(&PoolConfig { frames, ..PoolConfig::new("MysteryPath-v0", num_envs) }, &threads).unwrap()
    };
    let mut saving = pool(2, frames(3));
    saving.reset(ResetRequest::All, &mut zeroed(saving.layout().blocks())).unwrap();
    let mut saved = saving.save().unwrap().unwrap();
    assert_eq!(pool(1, frames(3)).resume(&saved), Err(ResumeError::Count { given: 2, num_envs: 1 }));
    let refused = pool(2, frames(1)).resume(&saved).unwrap_err();
    let source = SnapshotError::EarlierFrames { given: 2 * 84 * 84 * 3, expected: 0 };
    assert_eq!(refused, ResumeError::Environment { env: 0, source });
    saved[1].snapshot.pop();
    let refused = pool(2, frames(3)).resume(&saved).unwrap_err();
    assert_eq!(refused, ResumeError::Environment { env: 1, source: SnapshotError::Damaged });
}
