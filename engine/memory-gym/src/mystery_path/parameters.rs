//! The reset parameters of Mystery Path as typed values, their limits, and the variants of its ids.
//!
//! Source: `default_reset_parameters` and `process_reset_params` of the original.

use endless_gym_core::envs::ResetParameters;

/// Distinguishes the ids of Mystery Path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Variant {
    /// One screen with a goal; the agent moves by `agent_speed` in eight directions, limited by the screen's border.
    Free,
    /// One screen with a goal; the agent turns and walks from tile to tile.
    Grid,
    /// An endless path to the right, along which the screen scrolls; the agent moves right, up or down.
    Endless,
}

/// The original's default scale of the agent: a radius of 6 pixels.
pub const DEFAULT_AGENT_SCALE: f64 = 0.25;
/// Maximum scale of the agent: a radius of 100 pixels.
pub const MAX_AGENT_SCALE: f64 = 4.0;
/// Maximum `stamina_level`.
pub const MAX_STAMINA: i64 = 1_000_000_000;

/// One set of reset parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    /// Maximum steps per episode; unlimited if less than 1.
    pub max_steps: i64,
    /// Size of the agent, 0 to 4; 0.25 is a radius of 6 pixels.
    pub agent_scale: f64,
    /// Pixels per step, 0 to 84. Unused on a grid.
    pub agent_speed: f64,
    /// Sides on which the path may start, to draw from: 0 left, 1 right, 2 top, 3 bottom. Empty for the endless id.
    pub cardinal_origin_choice: Vec<i64>,
    /// Whether the path's first tile is shown.
    pub show_origin: bool,
    /// Whether the path's last tile is shown.
    pub show_goal: bool,
    /// Whether the path behind the endless agent is shown.
    pub show_past_path: bool,
    /// Whether a tiled background scrolls with the endless agent.
    pub show_background: bool,
    /// Whether a bar shows the endless agent's stamina.
    pub show_stamina: bool,
    /// Whether a red cross shows that the agent fell off the path.
    pub visual_feedback: bool,
    /// Number of tiles on the screen to the left of the endless agent, limited to 0 to 5.5; truncated, the number of past
    /// columns that are shown.
    pub camera_offset_scale: f64,
    /// Steps within which the endless agent must reach the next tile, at least 1.
    pub stamina_level: i64,
    /// Reward for reaching the goal.
    pub reward_goal: f64,
    /// Reward for falling off the path.
    pub reward_fall_off: f64,
    /// Reward for reaching a tile of the path for the first time in the episode.
    pub reward_path_progress: f64,
    /// Reward for reaching a tile of the path for the first time since the last fall.
    pub reward_path_progress_dense: f64,
    /// Reward for each step.
    pub reward_step: f64,
}

impl Parameters {
    /// Reads the parameters of the family from a checked set.
    pub fn new(variant: Variant, given: &ResetParameters) -> Self {
        Parameters {
            max_steps: given.int("max_steps", -1),
            agent_scale: match variant {
                // The grid id has the parameter, but the original draws its agent at the default scale.
                Variant::Grid => DEFAULT_AGENT_SCALE,
                Variant::Free | Variant::Endless => given.float("agent_scale", DEFAULT_AGENT_SCALE),
            },
            agent_speed: given.float("agent_speed", 0.0),
            cardinal_origin_choice: given.int_list("cardinal_origin_choice"),
            show_origin: match variant {
                Variant::Free | Variant::Grid => given.bool("show_origin", false),
                // The original requires `show_origin` to be both true and false, so the endless id never shows it.
                Variant::Endless => false,
            },
            show_goal: given.bool("show_goal", false),
            show_past_path: given.bool("show_past_path", false),
            show_background: given.bool("show_background", false),
            show_stamina: given.bool("show_stamina", false),
            visual_feedback: given.bool("visual_feedback", true),
            camera_offset_scale: given.float("camera_offset_scale", 0.0),
            stamina_level: given.int("stamina_level", 1),
            reward_goal: given.float("reward_goal", 0.0),
            reward_fall_off: given.float("reward_fall_off", 0.0),
            reward_path_progress: given.float("reward_path_progress", 0.0),
            reward_path_progress_dense: given.float("reward_path_progress_dense", 0.0),
            reward_step: given.float("reward_step", 0.0),
        }
    }
}
