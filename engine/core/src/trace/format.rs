//! The format of recorded episodes.

use std::io::{self, BufReader, Read, Write};
use std::path::Path;

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value as Json};
use thiserror::Error;

use crate::files;
use crate::pool::PoolError;

/// Maximum length of a trace's JSON in bytes, so that a small file that decompresses to any length does not exhaust memory. The
/// longest trace of the reference implementation has 2.4 MB, and lists in a trace take many times the memory of their text.
const MAX_BYTES: u64 = 8 << 20;

/// One recorded environment object.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct Trace {
    /// Environment id.
    pub env: String,
    /// Reset parameters that were given.
    pub options: Map<String, Json>,
    /// The episodes in the order in which they were played.
    pub episodes: Vec<Episode>,
    /// Number of steps after which the recording of an unfinished episode stops. The default is that of the reference traces:
    /// 700, or 200 in a trace with ground-truth views.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_steps: Option<usize>,
}

/// One recorded episode.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct Episode {
    /// Seed of the reset; `None` continues the previous episode's generator.
    pub seed: Option<u64>,
    /// CRC-32 of the first observation.
    pub reset_crc: u32,
    /// The reset's info.
    pub reset_info: Map<String, Json>,
    /// The first vector observation; empty if there is none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub reset_vector: Vec<f32>,
    /// The steps from the first to the last.
    pub steps: Vec<Step>,
}

/// One recorded step.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(from = "StepFields", into = "StepFields")]
pub struct Step {
    /// One number for each branch of the action space.
    pub action: Vec<i32>,
    /// The reward.
    pub reward: f64,
    /// Whether the step ended the episode.
    pub done: bool,
    /// CRC-32 of the observation.
    pub crc: u32,
    /// The step's info.
    pub info: Map<String, Json>,
    /// CRC-32 of the ground-truth view, if it was recorded.
    pub render_crc: Option<u32>,
}

/// A single-number action is a number, others are lists.
#[derive(Deserialize, Serialize)]
#[serde(untagged)]
enum Action {
    One(i32),
    Several(Vec<i32>),
}

/// A step as in the file: a list.
#[derive(Deserialize, Serialize)]
struct StepFields(
    Action,
    f64,
    bool,
    u32,
    Map<String, Json>,
    #[serde(default, skip_serializing_if = "Option::is_none")] Option<u32>,
);

impl From<StepFields> for Step {
    fn from(StepFields(action, reward, done, crc, info, render_crc): StepFields) -> Self {
        let action = match action {
            Action::One(action) => vec![action],
            Action::Several(action) => action,
        };
        Step { action, reward, done, crc, info, render_crc }
    }
}

impl From<Step> for StepFields {
    fn from(Step { action, reward, done, crc, info, render_crc }: Step) -> Self {
        let action = match *action {
            [action] => Action::One(action),
            _ => Action::Several(action),
        };
        StepFields(action, reward, done, crc, info, render_crc)
    }
}

impl Trace {
    /// Reads a trace file, gzipped JSON.
    ///
    /// # Errors
    ///
    /// [`TraceError::Open`], [`TraceError::Format`], [`TraceError::TooLong`], [`TraceError::Empty`] or [`TraceError::Truncated`].
    pub fn open(path: &Path) -> Result<Self, TraceError> {
        Self::read(files::open(path).map_err(TraceError::Open)?)
    }

    /// Like [`open`](Self::open), from any source of the file's bytes.
    ///
    /// # Errors
    ///
    /// [`TraceError::Format`], [`TraceError::TooLong`], [`TraceError::Empty`] or [`TraceError::Truncated`].
    pub fn read(file: impl Read) -> Result<Self, TraceError> {
        let mut text = GzDecoder::new(file).take(MAX_BYTES);
        let trace: Result<Self, _> = serde_json::from_reader(BufReader::new(&mut text));
        if text.limit() == 0 {
            return Err(TraceError::TooLong);
        }
        let trace = trace.map_err(TraceError::Format)?;
        trace.check_complete()?;
        Ok(trace)
    }

    /// Writes the trace as a file, gzipped JSON.
    ///
    /// # Errors
    ///
    /// If `file` cannot be written.
    pub fn write(&self, file: impl Write) -> io::Result<()> {
        let mut encoder = GzEncoder::new(file, Compression::best());
        serde_json::to_writer(&mut encoder, self)?;
        encoder.finish()?.flush()
    }

    /// Checks that no episode lacks its last steps: each has ended, or has the maximum number of recorded steps.
    ///
    /// # Errors
    ///
    /// [`TraceError::Empty`] or [`TraceError::Truncated`].
    pub fn check_complete(&self) -> Result<(), TraceError> {
        if self.episodes.is_empty() {
            return Err(TraceError::Empty);
        }
        let steps = || self.episodes.iter().flat_map(|episode| &episode.steps);
        let usual = if steps().any(|step| step.render_crc.is_some()) { 200 } else { 700 };
        let max_steps = self.max_steps.unwrap_or(usual);
        let complete = |steps: &[Step]| steps.last().is_some_and(|last| last.done) || steps.len() == max_steps;
        match self.episodes.iter().position(|episode| !complete(&episode.steps)) {
            None => Ok(()),
            Some(episode) => {
                Err(TraceError::Truncated { episode, steps: self.episodes[episode].steps.len(), max_steps })
            }
        }
    }
}

/// A trace cannot be read or replayed.
#[derive(Debug, Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages say what most fields are")]
pub enum TraceError {
    /// The file cannot be opened.
    #[error("the trace cannot be opened: {0}")]
    Open(std::io::Error),
    /// The file's content is not a trace.
    #[error("the file must be a trace (gzipped JSON): {0}")]
    Format(serde_json::Error),
    /// The file's content is too long.
    #[error("the trace must have fewer than {MAX_BYTES} bytes after decompression; record fewer episodes in each file")]
    TooLong,
    /// There are no episodes.
    #[error("the trace must have at least one episode, got none")]
    Empty,
    /// The last steps of an episode are missing.
    #[error(
        "the trace is truncated: episode {episode} must end with `done` or have {max_steps} steps, got {steps} steps without an end \
         (a recording with another limit states it as `max_steps`)"
    )]
    Truncated {
        /// Episode of the trace, from 0.
        episode: usize,
        steps: usize,
        max_steps: usize,
    },
    /// The environment does not exist, or the recorded reset parameters or actions are invalid.
    #[error(transparent)]
    Pool(#[from] PoolError),
}

#[cfg(test)]
mod tests {
    use super::*;

    fn compressed(text: impl Read) -> Vec<u8> {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
        io::copy(&mut { text }, &mut encoder).unwrap();
        encoder.finish().unwrap()
    }

    #[test]
    fn small_files_of_long_or_deep_content_are_refused() {
        let start = &br#"{"env":"MysteryPath-v0","options":{},"episodes":["#[..];
        let long = compressed(start.chain(io::repeat(b' ').take(1 << 27)));
        assert!(long.len() < 2_000_000);
        assert!(matches!(Trace::read(&*long), Err(TraceError::TooLong)));
        let deep = compressed(br#"{"options":{"a":"#.chain(io::repeat(b'[').take(10_000_000)));
        assert!(matches!(Trace::read(&*deep), Err(TraceError::Format(_))));
    }
}
