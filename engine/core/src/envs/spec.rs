//! What is fixed about an environment id: spaces, reset parameters, info columns.

use serde::Serialize;

use super::Family;
use super::action_space::ActionSpace;
use super::parameters::Parameter;

/// Width and height of an observation in pixels.
pub const SCREEN: usize = 84;

/// Bytes of one observation: 84x84 RGB.
pub const FRAME_BYTES: usize = SCREEN * SCREEN * 3;

/// A number with a name and a meaning: a column of the info or of the feature observation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Column {
    pub name: &'static str,
    pub description: &'static str,
}

/// A column of the final info.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct InfoColumn {
    pub name: &'static str,
    /// Whether the original's number is a Python int; otherwise it is a float.
    pub is_integer: bool,
    pub description: &'static str,
}

/// Everything that is fixed about an environment id.
#[derive(Debug, Serialize)]
pub struct Spec {
    /// The original's id, such as `MortarMayhem-v0`.
    pub id: &'static str,
    /// One line on what the agent has to do.
    pub summary: &'static str,
    /// The rules that the id plays by.
    #[serde(skip)]
    pub family: Family,
    pub action_space: ActionSpace,
    /// Numbers in the vector observation (float32 in 0..=1), 0 if there is none.
    pub vector_observation: usize,
    /// Numbers in the ground truth (float64 in 0..=1), 0 if there is none.
    pub ground_truth: usize,
    /// Columns of the final info beside `reward` and `length`.
    pub info: &'static [InfoColumn],
    /// Columns of the feature observation (float32), an option of ours.
    pub features: &'static [Column],
    /// Reset parameters with the original's names and defaults.
    pub parameters: &'static [Parameter],
    /// Frames a second at which a person would watch.
    pub render_fps: u32,
}
