//! A message to a browser: an engine's state as JSON, and the pixels of the environments that the browser shows.
//!
//! It consists of the length of the JSON text as a little-endian `u32`, the text, and the newest frame of each
//! environment, as stored in the batch or as the engine has drawn it.

use endless_gym_core::batch::{Batch, BatchSection, Frames, Section};
use endless_gym_core::raster::FrameShape;
use endless_gym_service::{BatchLease, Drawn, ServiceSpecification};
use serde::Deserialize;
use serde_json::{Value as Json, json};

/// Maximum number of environments that a browser shows at a time.
pub(crate) const MAX_SHOWN: usize = 144;

/// Which environments a browser shows.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Selection {
    /// Their group.
    pub group: usize,
    /// Their numbers in the group. Numbers that do not exist, and those after the first [`MAX_SHOWN`], are ignored.
    pub envs: Vec<usize>,
}

impl Default for Selection {
    fn default() -> Self {
        Selection { group: 0, envs: (0..16).collect() }
    }
}

impl Selection {
    /// The environments of the selection that the engine has.
    pub fn existing(&self, num_envs: usize) -> Vec<usize> {
        self.envs.iter().copied().filter(|env| *env < num_envs).take(MAX_SHOWN).collect()
    }
}

/// The memory layout of a frame: its strides in bytes. A grayscale frame has one channel.
fn describe(frames: Frames, FrameShape { width, height, channels }: FrameShape) -> Json {
    let format = frames.format;
    let channels = if format.grayscale { 1 } else { channels };
    let (pixel, channel) = if format.channels_first { (1, width * height) } else { (channels, 1) };
    let (x, y) = if format.row_major { (pixel, pixel * width) } else { (pixel * height, pixel) };
    json!({"width": width, "height": height, "channels": channels, "x": x, "y": y, "channel": channel, "stack": frames.stack})
}

/// The message with `about` as its JSON, and the selected environments' data from a batch. `drawn` is for batches without
/// frames.
pub(crate) fn encode(
    mut about: Json,
    specification: Option<&ServiceSpecification>,
    selection: &Selection,
    lease: Option<&BatchLease>,
    drawn: Option<&Drawn>,
) -> Vec<u8> {
    let mut pixels = Vec::<&[u8]>::new();
    if let (Some(specification), Some(lease)) = (specification, lease) {
        let (batch, mut envs) = (lease.batch(), selection.existing(specification.num_envs));
        let drawn = drawn.filter(|drawn| drawn.group == lease.group() && envs.starts_with(&drawn.envs));
        // If the frames are large, the engine draws only the first of them.
        envs.truncate(drawn.map_or(envs.len(), |drawn| drawn.envs.len()));
        about["batch"] = rows(specification, &batch, &envs);
        about["batch"]["step"] = json!(lease.step());
        about["batch"]["group"] = json!(lease.group());
        if let Some((frames, shape)) = specification.frames.zip(specification.frame) {
            about["batch"]["frame"] = describe(frames, shape);
            pixels = newest_frames(specification, frames, &batch, &envs);
        } else if let Some(drawn) = drawn {
            about["batch"]["frame"] = describe(Frames::default(), drawn.shape);
            pixels.push(&drawn.frames);
        }
    }
    let text = about.to_string();
    let mut message = Vec::with_capacity(4 + text.len() + pixels.iter().map(|frame| frame.len()).sum::<usize>());
    message.extend_from_slice(&u32::try_from(text.len()).unwrap_or_default().to_le_bytes());
    message.extend_from_slice(text.as_bytes());
    pixels.iter().for_each(|frame| message.extend_from_slice(frame));
    message
}

/// The newest frame of each environment's observation.
fn newest_frames<'a>(
    specification: &ServiceSpecification,
    frames: Frames,
    batch: &Batch<'a>,
    envs: &[usize],
) -> Vec<&'a [u8]> {
    let width = specification.batch.section(BatchSection::Observation).map_or(0, Section::width);
    // The stack is the first axis, oldest first.
    let length = width / frames.stack.max(1);
    let rows = envs.iter().filter_map(|env| batch.observation().get(env * width..(env + 1) * width));
    rows.map(|row| &row[width - length..]).collect()
}

/// The numbers of each environment.
fn rows(specification: &ServiceSpecification, batch: &Batch<'_>, envs: &[usize]) -> Json {
    let features = specification.features.len();
    let names = if specification.frames.is_none() { &specification.features[..] } else { &[] };
    let truths = specification.batch.section(BatchSection::GroundTruth).map_or(0, Section::width);
    let values: Vec<Json> = envs
        .iter()
        .map(|env| {
            let row = batch.features().get(env * features..(env + 1) * features).unwrap_or_default();
            json!({
                "env": env,
                "reward": batch.reward().get(*env),
                "return": batch.episode_return().get(*env),
                "length": batch.episode_length().get(*env),
                "ended": batch.has_ended(*env),
                "ground_truth": batch.ground_truth().get(env * truths..(env + 1) * truths),
                "features": if names.is_empty() { &[] } else { row },
            })
        })
        .collect();
    let described = specification.environment["ground_truth"].as_array().into_iter().flatten();
    let truths: Vec<&Json> = described.map(|column| &column["name"]).collect();
    json!({"envs": values, "features": names, "ground_truth": truths})
}
