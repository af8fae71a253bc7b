//! Tests that observations of other formats equal a plain conversion of the original's observation.

use std::collections::VecDeque;

use crate::support::player::{Player, random_actions};
use crate::support::recorded::pixel_formats;
use endless_gym::batch::{BatchSection, Frames, PixelFormat};
use endless_gym::envs::{EnvSpec, Parameter};
use endless_gym::memory_gym;
use endless_gym::pool::{Autoreset, PoolConfig, ResetOptions, Seeding};
use endless_gym_memory_gym::{FRAME, SCREEN};
use rand::SeedableRng;
use rand::rngs::SmallRng;
use serde_json::Value as Json;

const NUM_ENVS: usize = 3;

/// Converts a frame to another format, pixel by pixel.
fn convert(frame: &[u8], format: PixelFormat) -> Vec<u8> {
    let pixel = |first: usize, second: usize| -> [u8; 3] {
        let (x, y) = if format.row_major { (second, first) } else { (first, second) };
        let at = (x * SCREEN + y) * 3;
        [frame[at], frame[at + 1], frame[at + 2]]
    };
    let places = || (0..SCREEN).flat_map(|first| (0..SCREEN).map(move |second| (first, second)));
    if format.grayscale {
        let gray = |[red, green, blue]: [u8; 3]| {
            0.2125 * f64::from(red) + 0.7154 * f64::from(green) + 0.0721 * f64::from(blue)
        };
        places().map(|(first, second)| gray(pixel(first, second)) as u8).collect()
    } else if format.channels_first {
        (0..3).flat_map(|channel| places().map(move |(first, second)| pixel(first, second)[channel])).collect()
    } else {
        places().flat_map(|(first, second)| pixel(first, second)).collect()
    }
}

/// A pool, with short episodes if a reset parameter allows it.
fn started(spec: &EnvSpec, frames: Frames) -> Player {
    let is_max_steps = |parameter: &&Parameter| parameter.name == "max_steps";
    let options = spec.parameters.iter().find(is_max_steps).map(|_| ("max_steps".to_owned(), Json::from(70)));
    Player::started(
        &PoolConfig::new(spec.id, NUM_ENVS)
            .options(ResetOptions::Shared(options.into_iter().collect()))
            .frames(Some(frames))
            .seeding(Seeding::Continue { seed: Some(5) })
            .autoreset(Autoreset::SameStep)
            .final_observation(true),
    )
}

fn row(player: &Player, section: BatchSection, env: usize) -> &[u8] {
    let rows = player.batch().section::<u8>(section);
    let width = rows.len() / NUM_ENVS;
    &rows[env * width..(env + 1) * width]
}

/// Plays the same actions in both pools, and compares every observation with the conversion of the last standard ones.
fn compare(spec: &EnvSpec, frames: Frames, steps: usize) {
    let mut standard = started(spec, Frames::default());
    let mut other = started(spec, frames);
    let what = format!("{}: {frames:?}", spec.id);
    let section = other.pool.layout().section(BatchSection::Observation).unwrap();
    assert_eq!(section.shape(), frames.shape(FRAME), "{what}");
    let mut past: Vec<VecDeque<Vec<u8>>> = Vec::new();
    for env in 0..NUM_ENVS {
        past.push(vec![convert(row(&standard, BatchSection::Observation, env), frames.format); frames.stack].into());
    }
    let mut random = SmallRng::seed_from_u64(2);
    let mut episodes = 0;
    for step in 0..steps {
        for (env, past) in past.iter().enumerate() {
            let expected: Vec<u8> = past.iter().flatten().copied().collect();
            assert!(row(&other, BatchSection::Observation, env) == expected, "{what} step {step} environment {env}");
        }
        let actions = random_actions(spec, NUM_ENVS, &mut random);
        standard.step(&actions);
        other.step(&actions);
        for (env, past) in past.iter_mut().enumerate() {
            let newest = |section| convert(row(&standard, section, env), frames.format);
            past.pop_front();
            if standard.batch().terminated()[env] == 1 {
                episodes += 1;
                past.push_back(newest(BatchSection::FinalObservation));
                let expected: Vec<u8> = past.iter().flatten().copied().collect();
                assert!(
                    row(&other, BatchSection::FinalObservation, env) == expected,
                    "{what} step {step} environment {env}"
                );
                *past = vec![newest(BatchSection::Observation); frames.stack].into();
            } else {
                past.push_back(newest(BatchSection::Observation));
            }
        }
    }
    assert!(episodes > 0, "{what}: no episode ended");
}

#[test]
#[ignore = "slow"]
fn every_format_is_a_plain_conversion() {
    for (number, spec) in memory_gym().specs().enumerate() {
        // Each environment with half of the formats, and with the paper's grayscale stacks.
        for format in pixel_formats().filter(|format| usize::from(format.row_major) == number % 2) {
            compare(spec, Frames { format, stack: 1 }, 300);
        }
        let format = PixelFormat { grayscale: true, ..PixelFormat::default() };
        compare(spec, Frames { format, stack: 4 }, 300);
    }
    for format in pixel_formats() {
        compare(memory_gym().spec("Endless-MysteryPath-v0").unwrap(), Frames { format, stack: 3 }, 300);
    }
}

/// After a restored snapshot, the stack holds only its frame, as at the start of an episode.
#[test]
fn a_restored_stack_repeats_its_frame() {
    let format = PixelFormat { channels_first: true, ..PixelFormat::default() };
    let mut player = started(memory_gym().spec("MysteryPath-v0").unwrap(), Frames { format, stack: 2 });
    let snapshot = player.pool.snapshot(0).unwrap();
    (0..3).for_each(|_| player.step_all(1));
    player.pool.restore(1, &snapshot).unwrap();
    player.observe();
    let (first, second) = row(&player, BatchSection::Observation, 1).split_at(FRAME.bytes());
    assert!(first == second);
}
