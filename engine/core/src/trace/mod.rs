//! Recorded episodes of the original: their format, and their replay in this engine.
//!
//! A trace file is gzipped JSON: one environment object of the original that plays several episodes in a row.
//!
//! ```text
//! {"env": id, "options": {reset parameter: value},
//!  "episodes": [{"seed": number or null, "reset_crc": n, "reset_info": {}, "reset_vector": [..],
//!                "steps": [[action, reward, done, crc, info], ..]}]}
//! ```
//!
//! `crc` is the CRC-32 of the observation's bytes; a seed of `null` continues the object's generator; `reset_vector` is the
//! vector observation where there is one. A step may end with a sixth element, the CRC-32 of the ground-truth view.

mod replay;

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use flate2::read::GzDecoder;
use serde::Deserialize;
use serde_json::{Map, Value as Json};
use thiserror::Error;

use crate::pool::PoolError;
pub use replay::{Difference, Replay, replay};

/// One recorded environment object.
#[derive(Debug, Deserialize)]
pub struct Trace {
    pub env: String,
    pub options: Map<String, Json>,
    pub episodes: Vec<Episode>,
}

/// One recorded episode.
#[derive(Debug, Deserialize)]
pub struct Episode {
    pub seed: Option<u64>,
    pub reset_crc: u32,
    pub reset_info: Map<String, Json>,
    #[serde(default)]
    pub reset_vector: Vec<f32>,
    pub steps: Vec<Step>,
}

/// One recorded step.
#[derive(Debug, Deserialize)]
#[serde(from = "StepFields")]
pub struct Step {
    pub action: Vec<i32>,
    pub reward: f64,
    pub done: bool,
    pub crc: u32,
    pub info: Map<String, Json>,
    /// CRC-32 of the ground-truth view, where it was recorded.
    pub render_crc: Option<u32>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Action {
    One(i32),
    Several(Vec<i32>),
}

type StepWithoutRender = (Action, f64, bool, u32, Map<String, Json>);

#[derive(Deserialize)]
#[serde(untagged)]
enum StepFields {
    Plain(StepWithoutRender),
    Rendered(Action, f64, bool, u32, Map<String, Json>, u32),
}

impl From<StepFields> for Step {
    fn from(fields: StepFields) -> Self {
        let ((action, reward, done, crc, info), render_crc) = match fields {
            StepFields::Plain(fields) => (fields, None),
            StepFields::Rendered(action, reward, done, crc, info, render) => {
                ((action, reward, done, crc, info), Some(render))
            }
        };
        let action = match action {
            Action::One(action) => vec![action],
            Action::Several(action) => action,
        };
        Step { action, reward, done, crc, info, render_crc }
    }
}

impl Trace {
    /// Reads a trace file.
    pub fn open(path: &Path) -> Result<Self, TraceError> {
        let file = File::open(path).map_err(TraceError::Open)?;
        serde_json::from_reader(BufReader::new(GzDecoder::new(file))).map_err(TraceError::Format)
    }
}

/// A trace that cannot be replayed.
#[derive(Debug, Error)]
pub enum TraceError {
    #[error("cannot be opened: {0}")]
    Open(std::io::Error),
    #[error("is no trace (gzipped JSON): {0}")]
    Format(serde_json::Error),
    #[error(transparent)]
    Pool(#[from] PoolError),
}
