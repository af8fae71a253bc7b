//! Recorded episodes of the original replay without a difference.

mod common;

use endless_gym::trace::{Trace, TraceError, replay};

fn replay_all(prefix: &str) {
    for file in common::traces(prefix) {
        let trace = Trace::open(&file).unwrap();
        let replay = replay(&trace).unwrap();
        assert_eq!(replay.first, None, "{}", file.display());
        assert_eq!(replay.differences, 0, "{}", file.display());
        assert_eq!(replay.episodes, trace.episodes.len());
        assert_eq!(replay.steps, trace.episodes.iter().map(|episode| episode.steps.len()).sum::<usize>());
    }
}

#[test]
fn mortar_mayhem() {
    replay_all("MortarMayhem");
}

#[test]
fn mortar_mayhem_grid() {
    replay_all("MortarMayhem-Grid");
}

#[test]
fn mortar_mayhem_b() {
    replay_all("MortarMayhemB");
}

#[test]
fn mortar_mayhem_b_grid() {
    replay_all("MortarMayhemB-Grid");
}

#[test]
fn endless_mortar_mayhem() {
    replay_all("Endless-MortarMayhem");
}

/// A replay that finds nothing wrong with a wrong trace would prove nothing.
#[test]
fn every_kind_of_difference_is_found() {
    let open = |id: &str, file: usize| Trace::open(&common::traces(id)[file]).unwrap();
    type Change = fn(&mut Trace);
    let changes: [(&str, &str, usize, Change); 7] = [
        ("observation checksum", "MortarMayhem", 0, |trace| trace.episodes[1].reset_crc ^= 1),
        ("observation checksum", "MortarMayhem", 3, |trace| trace.episodes[1].steps[3].crc ^= 1),
        ("reward", "MortarMayhem", 3, |trace| trace.episodes[1].steps[3].reward += 1e-16),
        ("done", "MortarMayhem", 3, |trace| trace.episodes[1].steps[3].done = true),
        ("vector observation", "MortarMayhemB", 0, |trace| trace.episodes[1].reset_vector[0] += 1.0),
        ("info `success`", "MortarMayhem", 0, |trace| {
            trace.episodes[1].steps.last_mut().unwrap().info["success"] = 0.5.into();
        }),
        ("info `ground_truth`", "Endless-MortarMayhem", 0, |trace| {
            trace.episodes[1].steps[3].info.remove("ground_truth");
        }),
    ];
    for (what, id, file, change) in changes {
        let mut trace = open(id, file);
        change(&mut trace);
        let first = replay(&trace).unwrap().first.unwrap_or_else(|| panic!("{what} was not compared"));
        assert_eq!((first.what.as_str(), first.episode), (what, 1), "{first}");
    }
}

#[test]
fn a_trace_of_an_unknown_environment_is_an_error() {
    let mut trace = Trace::open(&common::traces("MortarMayhem")[0]).unwrap();
    trace.env = "NoSuchThing-v0".to_owned();
    assert!(matches!(replay(&trace), Err(TraceError::Pool(_))));
}
