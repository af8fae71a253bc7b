//! Recordings of this engine in the format of the original's traces, and the progress for viewers.

use crate::support::player::{Player, random_actions};
use endless_gym::batch::Batch;
use endless_gym::memory_gym;
use endless_gym::pool::{Autoreset, PoolConfig, ResetOptions, ResetRequest};
use endless_gym::trace::{Recorder, Trace, replay};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use serde_json::{Value as Json, json};

/// Converts all numbers in JSON to floats, since the original writes some ground truths as integers.
fn as_floats(json: Json) -> Json {
    match json {
        Json::Number(number) => json!(number.as_f64()),
        Json::Array(items) => items.into_iter().map(as_floats).collect(),
        Json::Object(fields) => fields.into_iter().map(|(name, value)| (name, as_floats(value))).collect(),
        other => other,
    }
}

/// Recording the original's actions here gives the original's file.
#[test]
fn a_recording_equals_the_original_trace() {
    for spec in memory_gym().specs() {
        let expected =
            Trace::open(&crate::support::recorded::reference().join(format!("traces/{}.03.mixed02.json.gz", spec.id)))
                .unwrap();
        let config = PoolConfig::new(spec.id, 1)
            .options(ResetOptions::Shared(expected.options.clone()))
            .autoreset(Autoreset::Disabled);
        let Player { mut pool, mut blocks } = Player::new(&config);
        let mut recorder = Recorder::new(spec.id, &expected.options);
        for episode in &expected.episodes {
            pool.reset(episode.seed.map_or(ResetRequest::All, ResetRequest::Seed), &mut blocks).unwrap();
            recorder.reset(episode.seed, &pool, &blocks);
            for step in &episode.steps {
                pool.step(&step.action, &mut blocks).unwrap();
                recorder.step(&step.action, &pool, &blocks);
            }
        }
        let mut file = Vec::new();
        recorder.write(&mut file).unwrap();
        let recorded = Trace::read(file.as_slice()).unwrap();
        assert_eq!(as_floats(json!(recorded.episodes)), as_floats(json!(expected.episodes)), "{}", spec.id);
        assert_eq!(json!(recorded.options), json!(expected.options), "{}", spec.id);
    }
}

/// A recording of an unfinished episode is complete in itself, but not as part of a longer one.
#[test]
fn unfinished_recordings_are_replayed() {
    let mut random = SmallRng::seed_from_u64(1);
    for spec in memory_gym().specs() {
        for steps in [0, 1, 25] {
            let config = PoolConfig::new(spec.id, 1).autoreset(Autoreset::Disabled);
            let Player { mut pool, mut blocks } = Player::new(&config);
            let mut recorder = Recorder::new(spec.id, &Default::default());
            pool.reset(ResetRequest::Seed(steps), &mut blocks).unwrap();
            recorder.reset(Some(steps), &pool, &blocks);
            for _ in 0..steps {
                let action = random_actions(spec, 1, &mut random);
                pool.step(&action, &mut blocks).unwrap();
                recorder.step(&action, &pool, &blocks);
                if Batch::new(pool.layout(), &blocks).terminated()[0] == 1 {
                    break;
                }
            }
            let mut file = Vec::new();
            recorder.write(&mut file).unwrap();
            let mut trace = Trace::read(file.as_slice()).unwrap();
            let replayed = replay(memory_gym(), &trace).unwrap();
            assert_eq!(replayed.differences, 0, "{}: {:?}", spec.id, replayed.first);
            if trace.max_steps.is_some() {
                trace.max_steps = Some(26);
                trace.check_complete().unwrap_err();
            }
        }
    }
}

/// The progress numbers during an episode end at those of the final info.
#[test]
fn progress_ends_at_the_final_info() {
    for spec in memory_gym().specs() {
        let config = PoolConfig::new(spec.id, 1).features(true).autoreset(Autoreset::Disabled);
        let Player { mut pool, mut blocks } = Player::new(&config);
        pool.progress(0).unwrap_err();
        let mut expert = memory_gym().expert(spec.id).unwrap();
        let mut random = SmallRng::seed_from_u64(2);
        // Mix in random actions, so that episodes end in all possible ways.
        for seed in 0..4 {
            pool.reset(ResetRequest::Seed(seed), &mut blocks).unwrap();
            expert.reset();
            let mut action = vec![0; spec.action_space.width()];
            for step in 0..5000 {
                let batch = Batch::new(pool.layout(), &blocks);
                expert.act(batch.features(), batch.vector_observation(), &mut action);
                if step > 100 && random.random_bool(0.2) {
                    let choices = spec.action_space.branches()[0];
                    action[0] = random.random_range(0..choices);
                }
                pool.step(&action, &mut blocks).unwrap();
                if Batch::new(pool.layout(), &blocks).terminated()[0] == 1 {
                    break;
                }
            }
            let batch = Batch::new(pool.layout(), &blocks);
            assert_eq!(batch.terminated(), [1], "{}", spec.id);
            let info = |name: &str| {
                let place = spec.info.iter().position(|column| column.name == name);
                place.map(|place| batch.info()[place])
            };
            let progress = pool.progress(0).unwrap();
            let shown = |name: &str| progress.iter().find(|shown| shown.name == name);
            let share = |name: &str| shown(name).map(|shown| shown.value / shown.of.unwrap_or(1.0));
            match spec.id {
                "Endless-MortarMayhem-v0" => assert_eq!(share("commands"), info("commands_completed")),
                // The original counts a failed last command as executed. It and the task progress count a command as failed if
                // the agent left its tile too early.
                id if id.starts_with("Mortar") => {
                    let (shown, of) = shown("commands").map(|shown| (shown.value, shown.of.unwrap())).unwrap();
                    let counted = (info("commands_completed").unwrap() * of).round();
                    let differs = shown - counted;
                    assert!(
                        [0.0, 1.0].contains(&differs) || (differs == -1.0 && counted == of),
                        "{id}: {shown} {counted}"
                    );
                    assert_eq!(info("task_progress"), Some(shown.min(counted) / of));
                }
                id if id.contains("MysteryPath") => {
                    assert_eq!(share("falls"), info("num_fails"));
                    assert!(info("tiles_visited").is_none_or(|tiles| share("tiles") == Some(tiles)), "{id}");
                    let progress = if id.contains("Grid") { info("success") } else { share("tiles") };
                    assert!(info("task_progress").is_none_or(|shown| progress == Some(shown)), "{id}");
                }
                _ => {
                    assert_eq!(share("coins"), info("coins_collected"));
                    let halves = info("success").map(|success| (share("coins").unwrap() + success) / 2.0);
                    assert_eq!(info("task_progress"), halves);
                    assert_eq!(share("health"), info("agent_health"));
                }
            }
        }
    }
}
