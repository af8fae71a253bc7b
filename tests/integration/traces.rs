//! Tests that recorded episodes of the original replay without a difference.

use std::io::Read;

use crate::support::player::Player;
use crate::support::recorded::{check_at_once, reference, traces, traces_with_views};
use endless_gym::memory_gym;
use endless_gym::pool::{Autoreset, PoolConfig, ResetOptions, ResetRequest};
use endless_gym::trace::{Trace, TraceError, replay};

/// Replays all traces of an id, those with ground-truth views last.
fn replay_all(id: &str) {
    let mut views = 0;
    for file in traces(id).into_iter().chain(traces_with_views(id)) {
        let trace = Trace::open(&file).unwrap();
        let replay = replay(memory_gym(), &trace).unwrap();
        assert_eq!(replay.first, None, "{}", file.display());
        assert_eq!(replay.differences, 0, "{}", file.display());
        assert_eq!(replay.episodes, trace.episodes.len());
        assert_eq!(replay.steps, trace.episodes.iter().map(|episode| episode.steps.len()).sum::<usize>());
        views += replay.views;
    }
    assert!(views > 0, "no ground-truth view of {id} was compared");
}

#[test]
fn recorded_episodes_replay_without_a_difference() {
    check_at_once(memory_gym().specs(), |spec| replay_all(spec.id));
}

/// Shows that a replay finds the differences in a wrong trace.
#[test]
fn every_kind_of_difference_is_found() {
    let open = |id: &str, file: usize| {
        let files = [traces(id), traces_with_views(id)].concat();
        Trace::open(&files[file.min(files.len() - 1)]).unwrap()
    };
    type Change = fn(&mut Trace);
    let changes: [(&str, &str, usize, Change); 8] = [
        ("observation checksum", "MortarMayhem-v0", 0, |trace| trace.episodes[1].reset_crc ^= 1),
        ("observation checksum", "MortarMayhem-v0", 3, |trace| trace.episodes[1].steps[3].crc ^= 1),
        ("reward", "MortarMayhem-v0", 3, |trace| trace.episodes[1].steps[3].reward += 1e-16),
        ("done", "MortarMayhem-v0", 3, |trace| trace.episodes[1].steps[3].done = true),
        ("vector observation", "MortarMayhemB-v0", 0, |trace| trace.episodes[1].reset_vector[0] += 1.0),
        ("ground-truth view checksum", "MortarMayhem-v0", usize::MAX, |trace| {
            *trace.episodes[1].steps[3].render_crc.as_mut().unwrap() ^= 1;
        }),
        ("info `success`", "MortarMayhem-v0", 0, |trace| {
            trace.episodes[1].steps.last_mut().unwrap().info["success"] = 0.5.into();
        }),
        ("info `ground_truth`", "Endless-MortarMayhem-v0", 0, |trace| {
            trace.episodes[1].steps[3].info.remove("ground_truth");
        }),
    ];
    for (what, id, file, change) in changes {
        let mut trace = open(id, file);
        change(&mut trace);
        let first = replay(memory_gym(), &trace).unwrap().first.unwrap_or_else(|| panic!("{what} was not compared"));
        assert_eq!((first.what.as_str(), first.episode), (what, 1), "{first}");
    }
}

/// Checksums show that a frame differs, the recorded frames where.
#[test]
fn the_first_frames_are_the_same_byte_by_byte() {
    for spec in memory_gym().specs() {
        let trace = Trace::open(&reference().join(format!("traces/{}.04.mixed20.json.gz", spec.id))).unwrap();
        let expected = recorded_frames(spec.id);
        let found = frames(&trace, expected.len());
        assert_eq!((expected.len(), found.len()), (40, 40), "{}", spec.id);
        for (number, (expected, (found, crc))) in expected.iter().zip(&found).enumerate() {
            let differs_at = expected.iter().zip(found).position(|(expected, found)| expected != found);
            assert_eq!((differs_at, found.len()), (None, expected.len()), "{}, frame {number}", spec.id);
            assert_eq!(crc32fast::hash(expected), *crc, "{}, frame {number}: the trace's checksum is another", spec.id);
        }
    }
}

/// Only the traces cover these reset parameters, since the published original, with which `tests/integration/live.rs`
/// compares, lacks them.
#[test]
fn traces_have_the_newest_reset_parameters() {
    for (trace, parameter) in [
        ("Endless-MortarMayhem-v0.05.mixed02", "reward_new_command_success"),
        ("Endless-MysteryPath-v0.05.mixed02", "reward_path_progress_dense"),
        ("Endless-SearingSpotlights-v0.13.mixed02", "coin_enabled"),
    ] {
        let trace = Trace::open(&reference().join(format!("traces/{trace}.json.gz"))).unwrap();
        assert!(trace.options.contains_key(parameter), "{parameter}: {:?}", trace.options);
    }
}

/// The recorded raw frames of an id.
fn recorded_frames(id: &str) -> Vec<Vec<u8>> {
    let file = std::fs::File::open(reference().join(format!("frames/{id}.gz"))).unwrap();
    let mut bytes = Vec::new();
    flate2::read::GzDecoder::new(file).read_to_end(&mut bytes).unwrap();
    let frames = bytes.chunks_exact(84 * 84 * 3);
    assert!(frames.remainder().is_empty(), "{id}: {} bytes are no whole number of frames", bytes.len());
    frames.map(<[u8]>::to_vec).collect()
}

/// The engine's first `count` frames when it plays a trace, with the trace's checksums.
fn frames(trace: &Trace, count: usize) -> Vec<(Vec<u8>, u32)> {
    let config = PoolConfig::new(&trace.env, 1)
        .options(ResetOptions::Shared(trace.options.clone()))
        .autoreset(Autoreset::Disabled);
    let mut player = Player::new(&config);
    let mut frames = Vec::new();
    for episode in &trace.episodes {
        player.reset(episode.seed.map_or(ResetRequest::All, ResetRequest::Seed));
        frames.push((player.batch().observation().to_vec(), episode.reset_crc));
        for step in &episode.steps {
            if frames.len() >= count {
                frames.truncate(count);
                return frames;
            }
            player.step(&step.action);
            frames.push((player.batch().observation().to_vec(), step.crc));
        }
    }
    frames
}

#[test]
fn a_trace_without_its_last_steps_is_an_error() {
    for (id, views) in [("MortarMayhem-v0", false), ("Endless-MortarMayhem-v0", false), ("MysteryPath-v0", true)] {
        for file in if views { traces_with_views(id) } else { traces(id) } {
            let truncated = |change: fn(&mut Trace)| {
                let mut trace = Trace::open(&file).unwrap();
                change(&mut trace);
                trace.check_complete()
            };
            let last = Trace::open(&file).unwrap().episodes.len() - 1;
            for change in [
                |trace: &mut Trace| drop(trace.episodes.last_mut().unwrap().steps.pop()),
                |trace: &mut Trace| trace.episodes.last_mut().unwrap().steps.truncate(1),
                |trace: &mut Trace| trace.episodes.last_mut().unwrap().steps.clear(),
            ] {
                let error = truncated(change).unwrap_err();
                assert!(matches!(error, TraceError::Truncated { episode, .. } if episode == last), "{error}");
            }
            assert!(matches!(truncated(|trace| trace.episodes.clear()), Err(TraceError::Empty)));
            // A recording with another step limit states it.
            let limited = truncated(|trace| {
                trace.max_steps = Some(10);
                trace.episodes.iter_mut().for_each(|episode| episode.steps.truncate(10));
            });
            assert!(limited.is_ok(), "{limited:?}");
        }
    }
}
