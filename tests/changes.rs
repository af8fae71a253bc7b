//! A copy of the observations that is kept up to date from a batch's changes equals the observations, whatever happens to the
//! environments and to the buffers.

mod common;

use endless_gym::batch::{
    Batch, BatchSection, Block, Frames, ObservationCopy, ObservationUpdater, PixelFormat, zeroed,
};
use endless_gym::envs::{self, EnvSpec, FRAME_BYTES};
use endless_gym::pool::{Autoreset, Pool, PoolConfig, ResetOptions, ResetRequest, Seeding, Threads};
use proptest::prelude::*;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

fn config(spec: &EnvSpec, num_envs: usize) -> PoolConfig {
    let seeding = Seeding::Continue { seed: Some(3) };
    PoolConfig { seeding, changes: true, ..PoolConfig::new(spec.id, num_envs) }
}

fn pool(config: &PoolConfig) -> Pool {
    Pool::new(config, &Threads::new(1).unwrap()).unwrap()
}

fn random_actions(pool: &Pool, random: &mut SmallRng) -> Vec<i32> {
    let branches = pool.spec().action_space.branches();
    (0..pool.layout().num_envs()).flat_map(|_| branches).map(|choices| random.random_range(0..*choices)).collect()
}

/// A reader of every batch, one of some batches, and one that copies rows to a third place.
struct Readers {
    every: ObservationCopy,
    some: ObservationCopy,
    updater: ObservationUpdater,
    host: Vec<u8>,
    device: Vec<u8>,
    rows: Vec<usize>,
    /// Bytes that the first copied, and batches.
    copied: usize,
    batches: usize,
}

impl Readers {
    fn new(pool: &Pool) -> Self {
        let every = ObservationCopy::new(pool.layout()).unwrap();
        let updater = ObservationUpdater::new(pool.layout()).unwrap();
        let bytes = updater.bytes();
        let (host, device) = (vec![0; bytes], vec![0; bytes]);
        Readers { some: every.clone(), every, updater, host, device, rows: Vec::new(), copied: 0, batches: 0 }
    }

    fn read(&mut self, pool: &Pool, buffer: &[Block], random: &mut SmallRng) {
        let batch = Batch::new(pool.layout(), buffer);
        let expected = batch.observation();
        self.copied += self.every.apply(&batch).unwrap();
        self.batches += 1;
        assert!(self.every.observations() == expected, "batch {} of {}", self.batches, pool.spec().id);
        if random.random_bool(0.3) {
            return;
        }
        self.some.apply(&batch).unwrap();
        assert!(self.some.observations() == expected, "batch {}, after others were left out", self.batches);
        let copied = self.updater.update_and_list(&batch, &mut self.host, &mut self.rows).unwrap();
        let length = self.updater.row_bytes();
        assert!(self.rows.is_sorted_by(|one, next| one < next) && copied <= self.rows.len() * length);
        for row in &self.rows {
            self.device[row * length..][..length].copy_from_slice(&self.host[row * length..][..length]);
        }
        assert!(self.host == expected && self.device == expected, "batch {}, by rows", self.batches);
    }
}

/// Plays with several buffers, to which happens what can happen to buffers, and with everything that changes environments. A step of
/// `other` writes into the same buffers.
fn play_irregularly(pool: &mut Pool, other: &mut Pool, steps: usize, random: &mut SmallRng) -> Readers {
    let num_envs = pool.layout().num_envs();
    let mut buffers: Vec<Vec<Block>> = vec![zeroed(pool.layout().blocks()); 4];
    let mut readers = Readers::new(pool);
    pool.reset(ResetRequest::All, &mut buffers[0]).unwrap();
    readers.read(pool, &buffers[0], random);
    other.reset(ResetRequest::All, &mut buffers[1]).unwrap();
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
            3 => {
                other.observe(&mut buffers[used]).unwrap();
                readers.read(other, &buffers[used], random);
            }
            4 => {
                let snapshot = [&*pool, &*other][random.random_range(0..2)].snapshot(0).unwrap();
                pool.restore(random.random_range(0..num_envs), &snapshot).unwrap();
            }
            5 => {
                let reset: Vec<u8> = (0..num_envs).map(|_| random.random_range(0..3)).collect();
                let seed: Vec<u64> = (0..num_envs).map(|_| random.random_range(0..1000)).collect();
                pool.reset(ResetRequest::Each { reset: &reset, seed: &seed }, &mut buffers[used]).unwrap();
                readers.read(pool, &buffers[used], random);
            }
            6 => {
                pool.reset(ResetRequest::Seed(random.random()), &mut buffers[used]).unwrap();
                readers.read(pool, &buffers[used], random);
            }
            7 => {
                let saved = pool.save().unwrap().unwrap();
                pool.step(&random_actions(pool, random), &mut buffers[used]).unwrap();
                readers.read(pool, &buffers[used], random);
                pool.resume(&saved).unwrap();
            }
            // A batch that no reader sees.
            8 => pool.step(&random_actions(pool, random), &mut buffers[used]).unwrap(),
            9 => other.step(&random_actions(other, random), &mut buffers[used]).unwrap(),
            // Most of the time one or a few of them in turn, as a trainer holds them.
            _ => {
                for buffer in &mut buffers[used..] {
                    pool.step(&random_actions(pool, random), buffer).unwrap();
                    readers.read(pool, buffer, random);
                }
            }
        }
    }
    readers
}

#[test]
fn copies_of_every_environment_equal_its_observations() {
    for spec in envs::specs() {
        let mut random = SmallRng::seed_from_u64(1);
        let (mut one, mut other) = (pool(&config(spec, 3)), pool(&config(spec, 3)));
        let readers = play_irregularly(&mut one, &mut other, 1000, &mut random);
        // A copy of everything would satisfy the rest of the test.
        let share = readers.copied as f64 / (readers.batches * 3 * FRAME_BYTES) as f64;
        assert!(share < 0.5, "{}: {share} of the bytes were copied", spec.id);
    }
}

/// Steps with one buffer and with two in turn, as trainers do: few bytes are copied.
#[test]
fn few_bytes_are_copied() {
    for (spec, buffers) in envs::specs().flat_map(|spec| [(spec, 1), (spec, 2)]) {
        let mut pool = pool(&config(spec, 8));
        let mut random = SmallRng::seed_from_u64(1);
        let (mut readers, mut buffers) = (Readers::new(&pool), vec![zeroed(pool.layout().blocks()); buffers]);
        pool.reset(ResetRequest::All, &mut buffers[0]).unwrap();
        readers.read(&pool, &buffers[0], &mut random);
        readers.copied = 0;
        let steps = 200;
        for step in 1..=steps {
            let used = step % buffers.len();
            pool.step(&random_actions(&pool, &mut random), &mut buffers[used]).unwrap();
            readers.read(&pool, &buffers[used], &mut random);
        }
        let bytes = readers.copied / (steps * 8);
        assert!(
            (1..FRAME_BYTES / 3).contains(&bytes),
            "{}: {bytes} bytes were copied for an environment and step",
            spec.id
        );
    }
}

#[test]
fn environments_of_several_threads_note_their_changes() {
    let spec = envs::spec("Endless-SearingSpotlights-v0").unwrap();
    let threads = Threads::new(3).unwrap();
    let [mut one, mut other] = [0, 1].map(|_| Pool::new(&config(spec, 100), &threads).unwrap());
    play_irregularly(&mut one, &mut other, 60, &mut SmallRng::seed_from_u64(5));
}

proptest! {
    #![proptest_config(common::property_cases(100))]

    #[test]
    fn copies_of_environments_of_any_options_equal_their_observations(
        (spec, given, others) in prop::sample::select(envs::specs().collect::<Vec<_>>())
            .prop_flat_map(|spec| (Just(spec), common::options(spec), common::options(spec))),
        autoreset in prop::sample::select(Autoreset::ALL.to_vec()),
        check_drawing: bool,
        independent_episodes: bool,
        format in prop_oneof![Just(PixelFormat::default()), common::pixel_format()],
        stack in prop::sample::select(vec![1, 1, 2, 3]),
        seed: u64,
    ) {
        let with = |given| PoolConfig {
            options: ResetOptions::Shared(given),
            autoreset,
            final_observation: true,
            check_drawing,
            independent_episodes,
            frames: Some(Frames { format, stack }),
            ..config(spec, 3)
        };
        let (mut one, mut other) = (pool(&with(given)), pool(&with(others)));
        play_irregularly(&mut one, &mut other, 120, &mut SmallRng::seed_from_u64(seed));
    }
}

/// Changes that are left out would be found.
#[test]
fn a_copy_depends_on_the_changes() {
    let spec = envs::spec("MysteryPath-Grid-v0").unwrap();
    let mut pool = pool(&config(spec, 2));
    let layout = pool.layout().clone();
    let (mut buffer, mut copy) = (zeroed(layout.blocks()), ObservationCopy::new(&layout).unwrap());
    pool.reset(ResetRequest::All, &mut buffer).unwrap();
    copy.apply(&Batch::new(&layout, &buffer)).unwrap();
    let before = copy.observations().to_vec();
    let mut random = SmallRng::seed_from_u64(1);
    for _ in 0..8 {
        pool.step(&random_actions(&pool, &mut random), &mut buffer).unwrap();
        layout.write::<u8>(&mut buffer, BatchSection::ChangedRows).fill(0);
        assert_eq!(copy.apply(&Batch::new(&layout, &buffer)), Ok(0));
    }
    assert!(Batch::new(&layout, &buffer).observation() != before && copy.observations() == before);
    // The same batch again is nothing new, until it is forgotten.
    assert_eq!(copy.apply(&Batch::new(&layout, &buffer)), Ok(0));
    layout.forget_frames(&mut buffer);
    assert_eq!(copy.apply(&Batch::new(&layout, &buffer)), Ok(2 * FRAME_BYTES));
    assert!(Batch::new(&layout, &buffer).observation() == copy.observations());
}

#[test]
fn without_changes_everything_is_copied() {
    let spec = envs::spec("MysteryPath-Grid-v0").unwrap();
    let mut pool = pool(&PoolConfig { changes: false, ..config(spec, 2) });
    let layout = pool.layout().clone();
    assert!(layout.section(BatchSection::ChangedRows).is_none());
    let (mut buffer, mut copy) = (zeroed(layout.blocks()), ObservationCopy::new(&layout).unwrap());
    pool.reset(ResetRequest::All, &mut buffer).unwrap();
    for _ in 0..3 {
        assert_eq!(copy.apply(&Batch::new(&layout, &buffer)), Ok(2 * FRAME_BYTES));
        pool.step(&[1, 2], &mut buffer).unwrap();
    }
    let blind = self::pool(&PoolConfig { frames: None, ..config(spec, 2) });
    let error = ObservationCopy::new(blind.layout()).unwrap_err();
    assert_eq!(error.to_string(), "a copy of observations needs a batch with the section `observation`");
    let larger = self::pool(&config(spec, 3));
    let error = ObservationCopy::new(larger.layout()).unwrap().apply(&Batch::new(&layout, &buffer)).unwrap_err();
    assert_eq!(error.to_string(), "observations and their copy must have 63504 bytes, got 42336");
}
