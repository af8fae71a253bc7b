//! An environment of one's own has all that a built-in one has. It is the T-maze of the examples.

#[path = "../../engine/examples/t_maze.rs"]
#[allow(dead_code)]
mod t_maze;

use endless_gym::batch::{Batch, Block, Frames, PixelFormat, zeroed};
use endless_gym::envs::InvalidState;
use endless_gym::memory_gym;
use endless_gym::pool::{
    Autoreset, DuplicateEnvironment, Pool, PoolConfig, Registry, ResetOptions, ResetRequest, SnapshotError, Threads,
};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use serde_json::json;

use t_maze::TMaze;

const ID: &str = "TMaze-v0";
const NUM_ENVS: usize = 6;
const AHEAD: i32 = 2;

fn registry() -> Registry {
    Registry::new().with::<TMaze>().unwrap()
}

/// Short mazes with features, whose frames are compared with frames that are drawn in full.
fn config(autoreset: Autoreset) -> PoolConfig {
    let options = json!({"length": 3, "max_steps": 8}).as_object().unwrap().clone();
    let options = ResetOptions::Shared(options);
    PoolConfig { options, autoreset, features: true, check_drawing: true, ..PoolConfig::new(ID, NUM_ENVS) }
}

fn pool(config: &PoolConfig, threads: usize) -> (Pool, Vec<Block>) {
    let pool = Pool::new(&registry(), config, &Threads::new(threads).unwrap()).unwrap();
    let blocks = zeroed(pool.layout().blocks());
    (pool, blocks)
}

/// Walks to the junction and turns to the side of the cue, or to the other side.
fn play(autoreset: Autoreset, turns_right: bool) -> Vec<f64> {
    let (mut pool, mut blocks) = pool(&config(autoreset), 1);
    pool.reset(ResetRequest::Seed(1), &mut blocks).unwrap();
    let cues: Vec<i32> =
        Batch::new(pool.layout(), &blocks).features().chunks_exact(2).map(|row| (row[0] == 1.0).into()).collect();
    assert!(cues.contains(&0) && cues.contains(&1));
    for _ in 0..3 {
        pool.step(&[AHEAD; NUM_ENVS], &mut blocks).unwrap();
    }
    let turns: Vec<i32> = cues.iter().map(|cue| if turns_right { *cue } else { 1 - cue }).collect();
    pool.step(&turns, &mut blocks).unwrap();
    let batch = Batch::new(pool.layout(), &blocks);
    assert_eq!((batch.terminated(), batch.truncated()), ([1; NUM_ENVS].as_slice(), [0; NUM_ENVS].as_slice()));
    assert_eq!(batch.info(), [f64::from(u8::from(turns_right)); NUM_ENVS]);
    batch.reward().to_vec()
}

#[test]
fn every_autoreset_mode_plays_a_task() {
    for autoreset in Autoreset::ALL {
        assert_eq!(play(autoreset, true), [1.0; NUM_ENVS]);
        assert_eq!(play(autoreset, false), [-1.0; NUM_ENVS]);
    }
}

#[test]
fn truncation_ends_an_episode_and_is_told_from_termination() {
    for autoreset in Autoreset::ALL {
        let (mut pool, mut blocks) = pool(&config(autoreset), 1);
        pool.reset(ResetRequest::All, &mut blocks).unwrap();
        for step in 1..=8 {
            pool.step(&[AHEAD; NUM_ENVS], &mut blocks).unwrap();
            let batch = Batch::new(pool.layout(), &blocks);
            assert_eq!(batch.truncated(), [u8::from(step == 8); NUM_ENVS], "{autoreset}, step {step}");
            assert_eq!(batch.terminated(), [0; NUM_ENVS]);
        }
        let junction = Batch::new(pool.layout(), &blocks).features()[1];
        assert_eq!(junction == 0.0, autoreset == Autoreset::SameStep, "the next episode has started in the same step");
    }
}

/// Steps and draws in that format; the pool compares each frame with one that is drawn in full.
fn rows(frames: Frames, threads: usize) -> Vec<Vec<u8>> {
    let (mut pool, mut blocks) = pool(&PoolConfig { frames: Some(frames), ..config(Autoreset::NextStep) }, threads);
    let mut random = SmallRng::seed_from_u64(3);
    pool.reset(ResetRequest::Seed(5), &mut blocks).unwrap();
    (0..60)
        .map(|_| {
            let actions: Vec<i32> = (0..NUM_ENVS).map(|_| random.random_range(0..3)).collect();
            pool.step(&actions, &mut blocks).unwrap();
            Batch::new(pool.layout(), &blocks).observation().to_vec()
        })
        .collect()
}

#[test]
fn frames_are_right_in_every_format_for_every_number_of_threads() {
    let gray = PixelFormat { grayscale: true, channels_first: true, row_major: true };
    for frames in [Frames::default(), Frames { format: gray, stack: 3 }] {
        let alone = rows(frames, 1);
        assert!(alone.iter().any(|frame| *frame != alone[0]));
        assert!(alone == rows(frames, 2), "{frames:?}");
    }
}

#[test]
fn a_snapshot_continues_identically_and_a_forged_one_is_refused() {
    let (mut pool, mut blocks) = pool(&config(Autoreset::NextStep), 1);
    pool.reset(ResetRequest::Seed(2), &mut blocks).unwrap();
    pool.step(&[AHEAD; NUM_ENVS], &mut blocks).unwrap();
    let snapshots: Vec<Vec<u8>> = (0..NUM_ENVS).map(|env| pool.snapshot(env).unwrap()).collect();
    let mut play = |pool: &mut Pool| -> Vec<f64> {
        let mut step = |actions| {
            pool.step(actions, &mut blocks).unwrap();
            Batch::new(pool.layout(), &blocks).reward().to_vec()
        };
        [[AHEAD; NUM_ENVS], [AHEAD; NUM_ENVS], [1; NUM_ENVS], [AHEAD; NUM_ENVS]].iter().flat_map(|a| step(a)).collect()
    };
    let first = play(&mut pool);
    snapshots.iter().enumerate().for_each(|(env, snapshot)| pool.restore(env, snapshot).unwrap());
    assert_eq!(play(&mut pool), first);

    // At the third cell of a maze that is shorter: the number in the snapshot's reset parameters is another.
    snapshots.iter().enumerate().for_each(|(env, snapshot)| pool.restore(env, snapshot).unwrap());
    pool.step(&[AHEAD; NUM_ENVS], &mut blocks).unwrap();
    let mut forged = pool.snapshot(0).unwrap();
    let length = forged.windows(10).position(|window| window == br#""length":3"#).unwrap() + 9;
    forged[length] = b'1';
    let checksum = crc32fast::hash(&forged[12..]).to_le_bytes();
    forged[8..12].copy_from_slice(&checksum);
    assert_eq!(pool.restore(0, &forged), Err(SnapshotError::State(InvalidState)));
}

#[test]
fn options_are_checked_and_ids_are_unique() {
    let given = json!({"length": 81}).as_object().unwrap().clone();
    let config = PoolConfig { options: ResetOptions::Shared(given), ..PoolConfig::new(ID, 1) };
    let error = Pool::new(&registry(), &config, &Threads::new(1).unwrap()).map(drop).unwrap_err();
    assert_eq!(error.to_string(), "reset parameter `length` must be an integer, 1 to 80, got 81");
    let error = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).map(drop).unwrap_err();
    assert!(error.to_string().starts_with("no environment `TMaze-v0`; there are MortarMayhem-v0, "), "{error}");
    let twice = registry().with::<TMaze>().map(drop);
    assert_eq!(twice, Err(DuplicateEnvironment { id: ID.to_owned() }));
    assert_eq!(memory_gym().clone().with::<TMaze>().unwrap().specs().count(), 11);
}
