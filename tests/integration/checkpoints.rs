//! Environments that are saved and resumed continue bit for bit, whatever their id, options, format, auto-reset and seeding.

use crate::support::player::{Player, random_actions};
use crate::support::recorded::{options, pixel_format, property_cases};
use endless_gym::batch::Frames;
use endless_gym::envs::EnvSpec;
use endless_gym::memory_gym;
use endless_gym::pool::{Autoreset, PoolConfig, ResetOptions, ResetRequest, ResumeError, Seeding, SnapshotError};
use proptest::prelude::*;
use rand::SeedableRng;
use rand::rngs::SmallRng;

const NUM_ENVS: usize = 3;

fn config(spec: &'static EnvSpec) -> impl Strategy<Value = PoolConfig> {
    let options = prop::collection::vec(options(spec), NUM_ENVS).prop_map(ResetOptions::Each);
    let seeding = prop_oneof![
        Just(Seeding::Continue { seed: None }),
        Just(Seeding::Continue { seed: Some(5) }),
        Just(Seeding::Range { start: 0, end: 100_000, step: 3, seed: Some(3) }),
        Just(Seeding::List(vec![9, 3, 27, 4])),
    ];
    let autoreset = prop::sample::select(Autoreset::ALL.to_vec());
    let frames = (pixel_format(), prop::sample::select(vec![1, 1, 2, 4]));
    let frames = prop::option::weighted(0.8, frames.prop_map(|(format, stack)| Frames { format, stack }));
    (options, seeding, autoreset, frames, any::<bool>()).prop_map(|(options, seeding, autoreset, frames, features)| {
        PoolConfig::new(spec.id, NUM_ENVS)
            .options(options)
            .seeding(seeding)
            .autoreset(autoreset)
            .frames(frames)
            .features(features)
            .final_observation(true)
            .check_drawing(true)
    })
}

/// Checks that a pool and a successor, which resumes the state that the pool saved after `before` steps, play the same
/// `after` steps.
fn compare(config: &PoolConfig, before: usize, after: usize) {
    let mut player = Player::new(config);
    assert_eq!(player.pool.save().unwrap(), None);
    player.reset(ResetRequest::All);
    let mut random = SmallRng::seed_from_u64(1);
    (0..before).for_each(|_| player.step_at_random(&mut random));
    let saved = player.pool.save().unwrap().unwrap();
    let mut successor = Player::new(config);
    successor.pool.resume(&saved).unwrap();
    assert_eq!(successor.pool.save().unwrap().unwrap(), saved);
    // Both start with a new buffer, since final observations are written only at the end of an episode.
    player.blocks.clone_from(&successor.blocks);
    player.observe();
    successor.observe();
    assert!(player.bytes() == successor.bytes(), "after {before} steps");
    for step in 0..after {
        let actions = random_actions(player.pool.spec(), NUM_ENVS, &mut random);
        player.step(&actions);
        successor.step(&actions);
        assert!(player.bytes() == successor.bytes(), "step {step} after {before}");
    }
}

#[test]
fn resumed_environments_continue_identically() {
    for spec in memory_gym().specs() {
        let mut runner = proptest::test_runner::TestRunner::new(property_cases(4));
        let run = runner.run(&(config(spec), 0..90usize), |(config, before)| {
            compare(&config, before, 60);
            Ok(())
        });
        run.unwrap_or_else(|error| panic!("{}: {error}", spec.id));
    }
}

#[test]
fn a_pending_reset_of_next_step_autoreset_is_part_of_the_state() {
    // Random agents fail soon, so that saves hit every phase of an episode's end.
    for autoreset in Autoreset::ALL {
        let config = PoolConfig::new("Endless-MortarMayhem-v0", NUM_ENVS)
            .autoreset(autoreset)
            .seeding(Seeding::Range { start: 0, end: 50, step: 1, seed: Some(1) });
        (100..120).for_each(|before| compare(&config, before, 3));
    }
}

#[test]
fn resuming_a_state_that_does_not_fit_is_an_error() {
    let frames = |stack| Some(Frames { stack, ..Frames::default() });
    let pool = |num_envs, frames| Player::new(&PoolConfig::new("MysteryPath-v0", num_envs).frames(frames));
    let mut saving = pool(2, frames(3));
    saving.reset(ResetRequest::All);
    let mut saved = saving.pool.save().unwrap().unwrap();
    let resume = |num_envs, stack, saved: &[_]| pool(num_envs, frames(stack)).pool.resume(saved).unwrap_err();
    assert_eq!(resume(1, 3, &saved), ResumeError::Count { given: 2, num_envs: 1 });
    let source = SnapshotError::EarlierFrames { given: 2 * 84 * 84 * 3, expected: 0 };
    assert_eq!(resume(2, 1, &saved), ResumeError::Environment { env: 0, source });
    saved[1].snapshot.pop();
    assert_eq!(resume(2, 3, &saved), ResumeError::Environment { env: 1, source: SnapshotError::Damaged });
}
