//! The reset parameters of Mystery Path as typed values, their limits, and the variants of its ids.
//!
//! Source: `default_reset_parameters` and `process_reset_params` of the original.

use crate::typed_parameters::{type_of, typed_parameters};
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
/// Maximum `stamina_level`.
pub const MAX_STAMINA: i64 = 1_000_000_000;

typed_parameters! {
    variant, given;
    max_steps: int(-1),
    agent_speed: float(0.0),
    cardinal_origin_choice: int_list(),
    show_goal: bool(false),
    show_past_path: bool(false),
    show_background: bool(false),
    show_stamina: bool(false),
    visual_feedback: bool(true),
    camera_offset_scale: float(0.0),
    stamina_level: int(1),
    reward_goal: float(0.0),
    reward_fall_off: float(0.0),
    reward_path_progress: float(0.0),
    reward_path_progress_dense: float(0.0),
    reward_step: float(0.0),
    ;
    /// Size of the agent. The grid id has the parameter, but the original draws its agent at the default scale.
    agent_scale: f64 = match variant {
        Variant::Grid => DEFAULT_AGENT_SCALE,
        Variant::Free | Variant::Endless => given.float("agent_scale", DEFAULT_AGENT_SCALE),
    },
    /// Whether the path's first tile is shown. The original's endless id requires `show_origin` to be both true and false, so it never
    /// shows it.
    show_origin: bool = variant != Variant::Endless && given.bool("show_origin", false),
}
