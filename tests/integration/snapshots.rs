//! Snapshots: a restored environment continues identically in any pool.

use endless_gym::batch::{Batch, Block, zeroed};
use endless_gym::envs;
use endless_gym::pool::{
    Pool, PoolConfig, ResetOptions, ResetRequest, SNAPSHOT_VERSION, Seeding, SnapshotError, Threads,
};
use proptest::prelude::*;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use serde_json::json;

fn pool(config: &PoolConfig) -> (Pool, Vec<Block>) {
    let mut pool = Pool::new(config, &Threads::new(1).unwrap()).unwrap();
    let mut blocks = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::All, &mut blocks).unwrap();
    (pool, blocks)
}

fn config(id: &str, seed: u64) -> PoolConfig {
    PoolConfig { seeding: Seeding::Continue { seed: Some(seed) }, features: true, ..PoolConfig::new(id, 1) }
}

fn random_actions(id: &str, random: &mut SmallRng) -> Vec<i32> {
    envs::spec(id).unwrap().action_space.branches().iter().map(|n| random.random_range(0..*n)).collect()
}

fn bytes<'a>(pool: &'a Pool, blocks: &'a [Block]) -> &'a [u8] {
    Batch::new(pool.layout(), blocks).bytes()
}

#[test]
fn a_restored_environment_continues_identically() {
    for spec in envs::specs() {
        for played in [0, 1, 7, 130] {
            let (mut original, mut blocks) = pool(&config(spec.id, 4));
            let mut random = SmallRng::seed_from_u64(played);
            for _ in 0..played {
                original.step(&random_actions(spec.id, &mut random), &mut blocks).unwrap();
            }
            let snapshot = original.snapshot(0).unwrap();
            let (mut restored, mut other_blocks) = pool(&config(spec.id, 99));
            restored.restore(0, &snapshot).unwrap();
            assert_eq!(restored.snapshot(0).unwrap(), snapshot);
            original.observe(&mut blocks).unwrap();
            restored.observe(&mut other_blocks).unwrap();
            assert!(bytes(&original, &blocks) == bytes(&restored, &other_blocks), "{} after {played}", spec.id);
            // Over the ends of episodes, so that the generator counts.
            for step in 0..400 {
                let actions = random_actions(spec.id, &mut random);
                original.step(&actions, &mut blocks).unwrap();
                restored.step(&actions, &mut other_blocks).unwrap();
                let same = bytes(&original, &blocks) == bytes(&restored, &other_blocks);
                assert!(same, "{}, step {step} after {played}", spec.id);
            }
        }
    }
}

#[test]
fn a_snapshot_contains_the_options() {
    let id = "MortarMayhem-v0";
    let options = json!({"arena_size": 3, "agent_scale": 0.4}).as_object().unwrap().clone();
    let (original, blocks) = pool(&PoolConfig { options: ResetOptions::Shared(options), ..config(id, 1) });
    let (mut restored, mut other_blocks) = pool(&config(id, 2));
    restored.restore(0, &original.snapshot(0).unwrap()).unwrap();
    restored.observe(&mut other_blocks).unwrap();
    assert!(bytes(&original, &blocks) == bytes(&restored, &other_blocks));
}

#[test]
fn a_snapshot_contains_the_position_in_the_seeds() {
    let seeding = Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(1) };
    let with_range = PoolConfig { seeding, ..config("MortarMayhem-v0", 0) };
    let (mut original, mut blocks) = pool(&with_range);
    let snapshot = original.snapshot(0).unwrap();
    original.reset(ResetRequest::All, &mut blocks).unwrap();
    let expected = bytes(&original, &blocks).to_vec();
    original.restore(0, &snapshot).unwrap();
    original.reset(ResetRequest::All, &mut blocks).unwrap();
    assert!(expected == bytes(&original, &blocks));
}

#[test]
fn broken_snapshots_are_typed_errors() {
    let (mut pool, _) = pool(&config("MortarMayhem-v0", 1));
    let snapshot = pool.snapshot(0).unwrap();
    let refused = |pool: &mut Pool, bytes: &[u8]| pool.restore(0, bytes).unwrap_err();
    assert_eq!(refused(&mut pool, b""), SnapshotError::NoSnapshot);
    assert_eq!(refused(&mut pool, &[0; 100]), SnapshotError::NoSnapshot);
    assert_eq!(refused(&mut pool, &snapshot[..snapshot.len() - 1]), SnapshotError::Damaged);
    let mut newer = snapshot.clone();
    newer[4] += 1;
    assert_eq!(refused(&mut pool, &newer), SnapshotError::Version { given: SNAPSHOT_VERSION + 1 });
    for place in 12..snapshot.len() {
        let mut damaged = snapshot.clone();
        damaged[place] ^= 0x40;
        assert_eq!(refused(&mut pool, &damaged), SnapshotError::Damaged);
    }
    let mut other = Pool::new(&config("MortarMayhem-Grid-v0", 1), &Threads::new(1).unwrap()).unwrap();
    assert_eq!(other.snapshot(0).unwrap_err(), SnapshotError::NotReset);
    assert_eq!(refused(&mut other, &snapshot), SnapshotError::NotReset);
    assert_eq!(refused(&mut other, b""), SnapshotError::NotReset, "before the snapshot is read");
    let mut blocks = zeroed(other.layout().blocks());
    other.reset(ResetRequest::All, &mut blocks).unwrap();
    assert!(matches!(refused(&mut other, &snapshot), SnapshotError::OtherEnvironment { .. }));
    assert!(matches!(pool.snapshot(1), Err(SnapshotError::NoSuchEnv { given: 1, num_envs: 1 })));
    assert_eq!(pool.snapshot(0).unwrap(), snapshot, "nothing has changed");
}

proptest! {
    #![proptest_config(crate::support::recorded::property_cases(400))]

    /// A forged snapshot, whose checksum fits, is refused or can be played: it never panics.
    #[test]
    fn forged_snapshots_do_not_panic(
        id in prop::sample::select(envs::specs().map(|spec| spec.id).collect::<Vec<_>>()),
        played in 0..60_usize,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        let (mut pool, mut blocks) = pool(&config(id, 1));
        let mut random = SmallRng::seed_from_u64(1);
        for _ in 0..played {
            pool.step(&random_actions(id, &mut random), &mut blocks).unwrap();
        }
        let mut forged = pool.snapshot(0).unwrap();
        for (place, value) in changes {
            let place = 12 + place.index(forged.len() - 12);
            forged[place] = value;
        }
        let checksum = crc32fast::hash(&forged[12..]);
        forged[8..12].copy_from_slice(&checksum.to_le_bytes());
        if pool.restore(0, &forged).is_ok() {
            pool.observe(&mut blocks).unwrap();
            for _ in 0..80 {
                pool.step(&random_actions(id, &mut random), &mut blocks).unwrap();
            }
        }
    }
}
