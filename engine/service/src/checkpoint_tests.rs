use endless_gym_core::batch::zeroed;
use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
use proptest::prelude::*;

use super::*;

/// A head and the file of a checkpoint of two groups, one of which was not reset.
fn checkpoint(name: &str) -> (CheckpointHead, Vec<u8>) {
    let path = std::env::temp_dir().join(format!("endless-checkpoint-{name}-{}", std::process::id()));
    let mut pool = Pool::new(&PoolConfig::new("MysteryPath-Grid-v0", 2), &Threads::new(1).unwrap()).unwrap();
    pool.reset(ResetRequest::Seed(1), &mut zeroed(pool.layout().blocks())).unwrap();
    let groups = vec![SavedGroup { step: 7, envs: pool.save().unwrap() }, SavedGroup { step: 0, envs: None }];
    let head = CheckpointHead {
        package: PACKAGE_VERSION.to_owned(),
        id: "MysteryPath-Grid-v0".to_owned(),
        num_envs: 2,
        groups: 2,
        autoreset: "next_step".to_owned(),
        frames: None,
        features: false,
        seeding: "continued generators".to_owned(),
        options: vec![Map::new()],
    };
    write(&path, &head, groups.clone()).unwrap();
    assert_eq!(read(&path, &head).unwrap(), Some(groups));
    assert!(!new_path(&path).exists());
    let bytes = fs::read(&path).unwrap();
    fs::remove_file(&path).unwrap();
    assert_eq!(read(&path, &head).unwrap(), None);
    (head, bytes)
}

#[test]
fn every_truncation_is_an_error() {
    let (head, bytes) = checkpoint("short");
    for length in 0..bytes.len() {
        decode(Path::new("file"), &bytes[..length], &head).unwrap_err();
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn an_altered_checkpoint_is_never_accepted(
        changes in prop::collection::vec((any::<prop::sample::Index>(), 1..=255u8), 1..4),
    ) {
        let (head, original) = checkpoint("altered");
        let mut bytes = original.clone();
        for (at, change) in changes {
            *at.get_mut(&mut bytes) ^= change;
        }
        prop_assume!(bytes != original);
        prop_assert!(decode(Path::new("file"), &bytes, &head).is_err());
    }

    /// With a checksum that matches, so that the decoder sees the content.
    #[test]
    fn a_forged_checkpoint_is_no_panic(
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..9),
        length in any::<prop::sample::Index>(),
        cut: bool,
    ) {
        let (head, mut bytes) = checkpoint("forged");
        for (at, value) in changes {
            *at.get_mut(&mut bytes[PREAMBLE..]) = value;
        }
        if cut {
            bytes.truncate(PREAMBLE + length.index(bytes.len() - PREAMBLE));
        }
        let checksum = crc32fast::hash(&bytes[PREAMBLE..]);
        bytes[8..PREAMBLE].copy_from_slice(&checksum.to_le_bytes());
        if let Ok(groups) = decode(Path::new("file"), &bytes, &head) {
            let mut pool = Pool::new(&PoolConfig::new("MysteryPath-Grid-v0", 2), &Threads::new(1).unwrap()).unwrap();
            for group in groups {
                let _ = group.envs.map(|envs| pool.resume(&envs));
            }
        }
    }
}

#[test]
fn foreign_files_and_other_environments_are_named() {
    let (head, bytes) = checkpoint("foreign");
    let message = |bytes: &[u8], head: &CheckpointHead| decode(Path::new("/a/b"), bytes, head).unwrap_err().to_string();
    assert_eq!(message(b"PK\x03\x04 something else", &head), "/a/b is not a checkpoint of an engine");
    let mut newer = bytes.clone();
    newer[4] = 9;
    assert!(message(&newer, &head).contains("must be of version 1, got version 9"));
    let mut damaged = bytes.clone();
    *damaged.last_mut().unwrap() ^= 1;
    assert_eq!(message(&damaged, &head), "checkpoint /a/b is damaged: its checksum differs");
    let other = CheckpointHead { num_envs: 5, ..head.clone() };
    assert_eq!(message(&bytes, &other), "checkpoint /a/b was saved with num_envs 2, and the engine has 5");
    let newer_package = CheckpointHead { package: "99.0.0".to_owned(), ..head };
    decode(Path::new("file"), &bytes, &newer_package).unwrap();
}

#[test]
fn a_place_that_cannot_be_written_is_found_out_at_once() {
    for (path, part) in [("/nowhere/file", "No such file"), ("/dev", "directory")] {
        let text = check_writable(Path::new(path)).unwrap_err().to_string();
        assert!(text.contains(path) && text.contains(part), "{text}");
    }
}
