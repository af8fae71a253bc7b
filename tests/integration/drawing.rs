//! Tests that updated frames equal frames that are drawn in full, in every buffer.
//!
//! Every pool here checks what it draws, so that a step fails if a frame is wrong. The replay of recorded traces does
//! so, too.

use crate::support::player::random_actions;
use crate::support::recorded::{options, pixel_format, property_cases};
use endless_gym::batch::{Batch, BatchSection, Block, Frames, zeroed};
use endless_gym::envs::EnvSpec;
use endless_gym::memory_gym;
use endless_gym::pool::{
    Autoreset, EnvReset, Pool, PoolConfig, PoolError, ResetOptions, ResetRequest, Seeding, Threads, WrongFrame,
};
use endless_gym_memory_gym::{FRAME, SCREEN};
use proptest::prelude::*;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use serde_json::json;

const NUM_ENVS: usize = 3;

fn config(spec: &EnvSpec) -> PoolConfig {
    let seeding = Seeding::Continue { seed: Some(3) };
    PoolConfig::new(spec.id, NUM_ENVS).seeding(seeding).check_drawing(true)
}

fn pool(config: &PoolConfig) -> Pool {
    Pool::new(memory_gym(), config, &Threads::new(1).unwrap()).unwrap()
}

/// Plays with several buffers, which are cleared, copied, overwritten and shared, and with every operation that changes
/// environments.
fn play_irregularly(pool: &mut Pool, other: &mut Pool, steps: usize, random: &mut SmallRng) -> Result<(), PoolError> {
    let spec = &pool.spec().clone();
    let mut buffers: Vec<Vec<Block>> = vec![zeroed(pool.layout().blocks()); 4];
    pool.reset(ResetRequest::All, &mut buffers[0])?;
    other.reset(ResetRequest::All, &mut buffers[1])?;
    for _ in 0..steps {
        let used = random.random_range(0..buffers.len());
        match random.random_range(0..60) {
            0 => buffers[used].fill(bytemuck::Zeroable::zeroed()),
            1 => buffers[used] = buffers[(used + 1) % 4].clone(),
            2 => {
                let frames = pool.layout().clone();
                frames.write::<u8>(&mut buffers[used], BatchSection::Observation).fill(77);
                frames.forget_frames(&mut buffers[used]);
            }
            3 => other.observe(&mut buffers[used])?,
            4 => {
                let snapshot = [&*pool, &*other][random.random_range(0..2)].snapshot(0).unwrap();
                pool.restore(random.random_range(0..NUM_ENVS), &snapshot).unwrap();
            }
            5 => {
                let each = [0; NUM_ENVS].map(|_| match random.random_range(0..3) {
                    0 => EnvReset::Keep,
                    1 => EnvReset::Next,
                    _ => EnvReset::Seed(random.random_range(0..1000)),
                });
                pool.reset(ResetRequest::Each(&each), &mut buffers[used])?;
            }
            6 => pool.reset(ResetRequest::Seed(random.random()), &mut buffers[used])?,
            7 => drop(pool.ground_truth_view(0)?),
            8 => other.step(&random_actions(spec, NUM_ENVS, random), &mut buffers[used])?,
            // Usually, use a few buffers in turn, like a trainer that holds batches.
            _ => {
                for buffer in &mut buffers[used..] {
                    pool.step(&random_actions(spec, NUM_ENVS, random), buffer)?;
                }
            }
        }
    }
    Ok(())
}

#[test]
#[ignore = "slow"]
fn every_environment_is_drawn_correctly_into_irregular_buffers() {
    for spec in memory_gym().specs() {
        let mut random = SmallRng::seed_from_u64(1);
        let (mut one, mut other) = (pool(&config(spec)), pool(&config(spec)));
        let played = play_irregularly(&mut one, &mut other, 1000, &mut random);
        assert!(played.is_ok(), "{}: {}", spec.id, played.unwrap_err());
    }
}

/// Circles of light are tested in blocks of 16, and up to 32 are searched for moves, so use numbers on both sides of
/// these limits.
#[test]
#[ignore = "slow"]
fn many_circles_of_light_are_drawn_correctly_into_irregular_buffers() {
    let spec = memory_gym().spec("SearingSpotlights-v0").unwrap();
    for spotlights in [15, 24, 34] {
        let options =
            [("initial_spawns", json!(spotlights)), ("spot_min_speed", json!(0.002)), ("spot_damage", json!(0.0))];
        let options = options.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
        let config = config(spec).options(ResetOptions::Shared(options));
        let mut random = SmallRng::seed_from_u64(spotlights);
        let played = play_irregularly(&mut pool(&config), &mut pool(&config), 300, &mut random);
        assert!(played.is_ok(), "{spotlights} spotlights: {}", played.unwrap_err());
    }
}

proptest! {
    #![proptest_config(property_cases(100))]

    #[test]
    #[ignore = "slow"]
    fn environments_with_any_options_are_drawn_correctly_into_irregular_buffers(
        (spec, given, others) in prop::sample::select(memory_gym().specs().collect::<Vec<_>>())
            .prop_flat_map(|spec| (Just(spec), options(spec), options(spec))),
        same_step: bool,
        format in pixel_format(),
        stack in prop::sample::select(vec![1, 1, 2, 3]),
        seed: u64,
    ) {
        let autoreset = if same_step { Autoreset::SameStep } else { Autoreset::NextStep };
        let with = |given| config(spec).options(ResetOptions::Shared(given)).autoreset(autoreset).final_observation(true).frames(Some(Frames { format, stack }));
        let (mut one, mut other) = (pool(&with(given)), pool(&with(others)));
        let mut random = SmallRng::seed_from_u64(seed);
        let played = play_irregularly(&mut one, &mut other, 120, &mut random);
        prop_assert!(played.is_ok(), "{}: {}", spec.id, played.unwrap_err());
    }
}

/// A pool without frames draws the frames that a pool with frames has, and drawing them changes nothing.
#[test]
fn a_single_frame_equals_the_observation_even_without_frames_in_the_batch() {
    for spec in memory_gym().specs() {
        for autoreset in [Autoreset::SameStep, Autoreset::NextStep] {
            let with = |frames| pool(&config(spec).features(true).frames(frames).autoreset(autoreset));
            let (mut seen, mut drawn) = (with(Some(Frames::default())), with(None));
            assert!(matches!(drawn.frame(0), Err(PoolError::NotReset)));
            let mut buffers = [&seen, &drawn].map(|pool| zeroed(pool.layout().blocks()));
            let mut random = SmallRng::seed_from_u64(2);
            seen.reset(ResetRequest::All, &mut buffers[0]).unwrap();
            drawn.reset(ResetRequest::All, &mut buffers[1]).unwrap();
            for step in 0..150 {
                let observation = Batch::new(seen.layout(), &buffers[0]).observation().to_vec();
                for (env, expected) in observation.chunks_exact(FRAME.bytes()).enumerate() {
                    assert!(drawn.frame(env).unwrap() == expected, "{} step {step} environment {env}", spec.id);
                }
                let actions = random_actions(spec, NUM_ENVS, &mut random);
                seen.step(&actions, &mut buffers[0]).unwrap();
                drawn.step(&actions, &mut buffers[1]).unwrap();
                let [one, other] = [Batch::new(seen.layout(), &buffers[0]), Batch::new(drawn.layout(), &buffers[1])];
                assert_eq!((one.features(), one.reward()), (other.features(), other.reward()));
            }
            assert!(matches!(drawn.frame(NUM_ENVS), Err(PoolError::NoSuchEnv { given: NUM_ENVS, num_envs: NUM_ENVS })));
        }
    }
}

/// Shows that the check can fail.
#[test]
fn the_drawing_check_finds_a_changed_pixel() {
    let spec = memory_gym().spec("MortarMayhem-Grid-v0").unwrap();
    let mut pool = pool(&config(spec));
    let layout = pool.layout().clone();
    let mut buffer = zeroed(layout.blocks());
    pool.reset(ResetRequest::All, &mut buffer).unwrap();
    let (env, x, y) = (1, 83, 2);
    let corrupt = |buffer: &mut [Block]| {
        layout.write::<u8>(buffer, BatchSection::Observation)[env * FRAME.bytes() + (x * SCREEN + y) * 3 + 1] ^= 1;
    };

    corrupt(&mut buffer);
    let error = pool.step(&[0; NUM_ENVS], &mut buffer).unwrap_err();
    let PoolError::WrongFrame(WrongFrame { expected, found, .. }) = &error else { panic!("{error}") };
    assert_eq!(expected ^ 1, *found);
    assert!(matches!(error, PoolError::WrongFrame(WrongFrame { env: 1, pixel: (83, 2), .. })), "{error}");
    assert!(error.to_string().contains("environment 1 is wrong at pixel (83, 2)"), "{error}");

    // After an error, frames are drawn in full; and changing a frame after `forget_frames` is not an error.
    pool.step(&[0; NUM_ENVS], &mut buffer).unwrap();
    corrupt(&mut buffer);
    layout.forget_frames(&mut buffer);
    pool.step(&[0; NUM_ENVS], &mut buffer).unwrap();

    // Without the check, the changed pixel stays.
    let mut unchecked = Pool::new(memory_gym(), &config(spec).check_drawing(false), &Threads::new(1).unwrap()).unwrap();
    unchecked.reset(ResetRequest::All, &mut buffer).unwrap();
    let before = Batch::new(&layout, &buffer).observation().to_vec();
    corrupt(&mut buffer);
    unchecked.observe(&mut buffer).unwrap();
    assert!(Batch::new(&layout, &buffer).observation() != before);
}
