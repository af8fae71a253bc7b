//! Replays a trace and compares everything that the reference implementation returned.

use std::fmt;

use serde_json::{Map, Value as Json};

use super::format::{Trace, TraceError};
use crate::batch::{Batch, Block, zeroed};
use crate::envs::InfoColumn;
use crate::pool::{Autoreset, EnvReset, Pool, PoolConfig, Registry, ResetOptions, ResetRequest, Seeding, Threads};

/// The outcome of a replay.
#[derive(Debug, Default)]
pub struct Replay {
    /// Number of episodes that were compared.
    pub episodes: usize,
    /// Number of steps that were compared.
    pub steps: usize,
    /// Number of values that differ.
    pub differences: usize,
    /// The first value that differs.
    pub first: Option<Difference>,
    /// Number of ground-truth views that were compared.
    pub views: usize,
}

/// One value that differs.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Episode of the trace, from 0.
    pub episode: usize,
    /// Step of the episode, from 1; 0 is the reset.
    pub step: usize,
    /// Which value differs.
    pub what: String,
    /// The recorded value.
    pub expected: String,
    /// This engine's value.
    pub found: String,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Difference { episode, step, what, expected, found } = self;
        write!(f, "episode {episode}, step {step}: {what} expected {expected}, found {found}")
    }
}

impl Replay {
    fn compare<T: PartialEq + fmt::Debug>(&mut self, step: usize, what: &str, expected: T, found: T) {
        if expected == found {
            return;
        }
        self.differences += 1;
        self.first.get_or_insert_with(|| Difference {
            episode: self.episodes,
            step,
            what: what.to_owned(),
            expected: format!("{expected:?}"),
            found: format!("{found:?}"),
        });
    }
}

/// Replays `trace` and counts the values that differ.
///
/// # Errors
///
/// [`TraceError::Pool`] if the trace's environment, reset parameters or actions are invalid.
///
/// ```
/// use endless_gym_memory_gym::memory_gym;
/// use endless_gym_core::trace::{Trace, replay};
///
/// let text = r#"{"env": "MysteryPath-Grid-v0", "options": {}, "episodes": [
///     {"seed": 1, "reset_crc": 0, "reset_info": {}, "steps": [[0, 0.0, false, 0, {}]]}]}"#;
/// let trace: Trace = serde_json::from_str(text)?;
/// let outcome = replay(memory_gym(), &trace)?;
/// assert_eq!((outcome.episodes, outcome.steps), (1, 1));
/// // The two checksums of observations are wrong.
/// assert_eq!(outcome.differences, 2);
/// assert_eq!(outcome.first.unwrap().what, "observation checksum");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn replay(registry: &Registry, trace: &Trace) -> Result<Replay, TraceError> {
    let config = PoolConfig::new(&trace.env, 1)
        .options(ResetOptions::Shared(trace.options.clone()))
        .autoreset(Autoreset::Disabled)
        .check_drawing(true)
        // Only used by a first episode without a seed, since not every platform has a source of entropy.
        .seeding(Seeding::Continue { seed: Some(0) });
    let mut pool = Pool::new(registry, &config, &Threads::new(1)?)?;
    let mut blocks = zeroed(pool.layout().blocks());
    let mut replay = Replay::default();
    for episode in &trace.episodes {
        match episode.seed {
            Some(seed) => pool.reset(ResetRequest::Each(&[EnvReset::Seed(seed)]), &mut blocks)?,
            None => pool.reset(ResetRequest::All, &mut blocks)?,
        }
        let batch = Batch::new(pool.layout(), &blocks);
        replay.compare(0, "observation checksum", episode.reset_crc, crc32fast::hash(batch.observation()));
        replay.compare(0, "vector observation", &*episode.reset_vector, batch.vector_observation());
        compare_info(&mut replay, 0, &episode.reset_info, &info(&pool, &blocks, false));
        for (step, expected) in (1..).zip(&episode.steps) {
            pool.step(&expected.action, &mut blocks)?;
            let batch = Batch::new(pool.layout(), &blocks);
            replay.compare(step, "observation checksum", expected.crc, crc32fast::hash(batch.observation()));
            replay.compare(step, "reward", expected.reward, batch.reward()[0]);
            replay.compare(step, "done", expected.done, batch.has_ended(0));
            compare_info(&mut replay, step, &expected.info, &info(&pool, &blocks, expected.done));
            if let Some(crc) = expected.render_crc {
                let view = pool.ground_truth_view(0)?;
                replay.compare(step, "ground-truth view checksum", crc, crc32fast::hash(&view.pixels));
                replay.views += 1;
            }
            replay.steps += 1;
        }
        replay.episodes += 1;
    }
    Ok(replay)
}

/// The info dictionary in the form of a trace, of the pool's only environment.
pub(super) fn info(pool: &Pool, blocks: &[Block], done: bool) -> Vec<(&'static str, Vec<f64>)> {
    let batch = Batch::new(pool.layout(), blocks);
    let mut info = Vec::new();
    let ground_truth = batch.ground_truth();
    if !ground_truth.is_empty() {
        info.push(("ground_truth", ground_truth.to_vec()));
    }
    if done {
        info.push(("reward", batch.episode_return().to_vec()));
        info.push(("length", vec![f64::from(batch.episode_length()[0])]));
        let columns = pool.spec().info.iter().zip(batch.info());
        let original = columns.filter(|(column, _)| column.name != InfoColumn::TASK_PROGRESS.name);
        info.extend(original.map(|(column, value)| (column.name, vec![*value])));
    }
    info
}

fn compare_info(replay: &mut Replay, step: usize, expected: &Map<String, Json>, found: &[(&str, Vec<f64>)]) {
    for (name, value) in expected {
        let value: Option<Vec<f64>> = match value {
            Json::Array(values) => values.iter().map(Json::as_f64).collect(),
            // JSON has no NaN.
            Json::Null => Some(vec![f64::NAN]),
            value => value.as_f64().map(|value| vec![value]),
        };
        let found = found.iter().find(|(key, _)| key == name).map(|(_, value)| value.clone());
        if !both_are_nan(&value, &found) {
            replay.compare(step, &format!("info `{name}`"), value, found);
        }
    }
    for (name, value) in found.iter().filter(|(name, _)| !expected.contains_key(*name)) {
        replay.compare(step, &format!("info `{name}`"), None, Some(value));
    }
}

fn both_are_nan(one: &Option<Vec<f64>>, other: &Option<Vec<f64>>) -> bool {
    let is_nan =
        |value: &Option<Vec<f64>>| value.as_deref().is_some_and(|numbers| matches!(numbers, [n] if n.is_nan()));
    is_nan(one) && is_nan(other)
}
