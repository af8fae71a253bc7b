//! What a snapshot contains, and broken ones. The checks of `conformance` play on from snapshots.

use crate::support::player::Player;
use endless_gym::pool::{Pool, PoolConfig, ResetOptions, ResetRequest, SNAPSHOT_VERSION, Seeding, SnapshotError};
use serde_json::json;

fn config(id: &str, seed: u64) -> PoolConfig {
    PoolConfig::new(id, 1).seeding(Seeding::Continue { seed: Some(seed) }).features(true)
}

#[test]
fn a_snapshot_contains_the_options() {
    let id = "MortarMayhem-v0";
    let options = json!({"arena_size": 3, "agent_scale": 0.4}).as_object().unwrap().clone();
    let original = Player::started(&config(id, 1).options(ResetOptions::Shared(options)));
    let mut restored = Player::started(&config(id, 2));
    restored.pool.restore(0, &original.pool.snapshot(0).unwrap()).unwrap();
    restored.observe();
    assert!(original.bytes() == restored.bytes());
}

#[test]
fn broken_snapshots_are_typed_errors() {
    let mut pool = Player::started(&config("MortarMayhem-v0", 1)).pool;
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
    let Player { pool: mut other, mut blocks } = Player::new(&config("MortarMayhem-Grid-v0", 1));
    assert_eq!(other.snapshot(0).unwrap_err(), SnapshotError::NotReset);
    assert_eq!(refused(&mut other, &snapshot), SnapshotError::NotReset);
    assert_eq!(refused(&mut other, b""), SnapshotError::NotReset, "before the snapshot is read");
    other.reset(ResetRequest::All, &mut blocks).unwrap();
    assert!(matches!(refused(&mut other, &snapshot), SnapshotError::OtherEnvironment { .. }));
    assert!(matches!(pool.snapshot(1), Err(SnapshotError::NoSuchEnv { given: 1, num_envs: 1 })));
    assert_eq!(pool.snapshot(0).unwrap(), snapshot, "nothing has changed");
}
