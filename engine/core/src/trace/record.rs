//! Recordings of this engine, in the format of the traces of a reference implementation.

use std::io::{self, Write};

use serde_json::{Map, Value as Json};

use super::format::{Episode, Step, Trace};
use super::replay::info;
use crate::batch::{Batch, Block};
use crate::pool::{OptionMap, Pool};

/// Records the episodes of a pool of one environment, with the default frames and [`Autoreset::Disabled`].
///
/// [`Autoreset::Disabled`]: crate::pool::Autoreset::Disabled
///
/// ```
/// use endless_gym_core::batch::zeroed;
/// use endless_gym_memory_gym::memory_gym;
/// use endless_gym_core::pool::{Autoreset, Pool, PoolConfig, ResetRequest, Threads};
/// use endless_gym_core::trace::{Recorder, Trace, replay};
///
/// let config = PoolConfig::new("MysteryPath-v0", 1).autoreset(Autoreset::Disabled);
/// let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1)?)?;
/// let mut blocks = zeroed(pool.layout().blocks());
/// let mut recorder = Recorder::new("MysteryPath-v0", &Default::default());
/// pool.reset(ResetRequest::Seed(3), &mut blocks)?;
/// recorder.reset(Some(3), &pool, &blocks);
/// for _ in 0..20 {
///     pool.step(&[2, 0], &mut blocks)?;
///     recorder.step(&[2, 0], &pool, &blocks);
/// }
/// let mut file = Vec::new();
/// recorder.write(&mut file)?;
/// assert_eq!(replay(memory_gym(), &Trace::read(file.as_slice())?)?.differences, 0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Recorder {
    trace: Trace,
}

impl Recorder {
    /// A recording without episodes.
    pub fn new(env: &str, options: &OptionMap) -> Self {
        let trace = Trace { env: env.to_owned(), options: options.clone(), episodes: Vec::new(), max_steps: None };
        Recorder { trace }
    }

    /// Starts an episode whose first observation is in `blocks`.
    pub fn reset(&mut self, seed: Option<u64>, pool: &Pool, blocks: &[Block]) {
        let batch = Batch::new(pool.layout(), blocks);
        self.trace.episodes.push(Episode {
            seed,
            reset_crc: crc32fast::hash(batch.observation()),
            reset_info: json_info(pool, blocks, false),
            reset_vector: batch.vector_observation().to_vec(),
            steps: Vec::new(),
        });
    }

    /// Adds the step in `blocks` to the last episode. Does nothing if there is no episode.
    pub fn step(&mut self, action: &[i32], pool: &Pool, blocks: &[Block]) {
        let Some(episode) = self.trace.episodes.last_mut() else { return };
        let batch = Batch::new(pool.layout(), blocks);
        let done = batch.has_ended(0);
        episode.steps.push(Step {
            action: action.to_vec(),
            reward: batch.reward()[0],
            done,
            crc: crc32fast::hash(batch.observation()),
            info: json_info(pool, blocks, done),
            render_crc: None,
        });
    }

    /// Writes the trace as gzipped JSON. If the last episode has not ended, the file says that the recording stopped there.
    ///
    /// # Errors
    ///
    /// If `out` cannot be written.
    pub fn write(&self, out: impl Write) -> io::Result<()> {
        let unfinished = self.trace.episodes.last().filter(|last| last.steps.last().is_none_or(|step| !step.done));
        Trace { max_steps: unfinished.map(|episode| episode.steps.len()), ..self.trace.clone() }.write(out)
    }
}

/// The info dictionary as JSON, with the types of Python.
fn json_info(pool: &Pool, blocks: &[Block], done: bool) -> Map<String, Json> {
    let is_integer =
        |name: &str| name == "length" || pool.spec().info.iter().any(|column| column.name == name && column.is_integer);
    let json = |(name, values): (&str, Vec<f64>)| {
        let value = match values[..] {
            _ if name == "ground_truth" => Json::from(values),
            [value] if is_integer(name) => Json::from(value as i64),
            // NaN becomes null.
            [value] => Json::from(value),
            _ => Json::from(values),
        };
        (name.to_owned(), value)
    };
    info(pool, blocks, done).into_iter().map(json).collect()
}
