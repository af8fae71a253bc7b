//! The reset parameters of Mortar Mayhem as typed values, their limits, and the variants of its ids.
//!
//! Source: `default_reset_parameters` and `process_reset_params` of the original.

use super::commands::COMMANDS;
use crate::typed_parameters::{type_of, typed_parameters};
use endless_gym_core::envs::ResetParameters;

/// Distinguishes the ids of Mortar Mayhem.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Variant {
    /// How the agent moves.
    pub locomotion: Locomotion,
    /// The commands are provided as a vector observation and never shown.
    pub commands_given: bool,
    /// The sequence of commands grows until the agent fails.
    pub endless: bool,
    /// The agent starts up to two pixels off its tile's centre.
    pub start_offset: bool,
}

/// How the agent of Mortar Mayhem moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Locomotion {
    /// By `agent_speed` in eight directions, limited by the arena's border.
    Free,
    /// By `agent_speed` in eight directions, wrapping around the edges of the screen.
    Wrapping,
    /// Turns and walks from tile to tile.
    Grid,
}

/// Maximum duration and delay in steps.
pub const MAX_DURATION: i64 = 1000;
/// Maximum number of commands of an id that shows them.
pub const MAX_COMMANDS: i64 = 1000;

/// Tiles along a side of the endless arena, which fills the screen.
const ENDLESS_ARENA_SIZE: i64 = 6;

typed_parameters! {
    variant, given;
    max_steps: int(-1),
    agent_speed: float(0.0),
    command_count: int_list(),
    command_show_duration: int_list(),
    command_show_delay: int_list(),
    explosion_duration: int_list(),
    explosion_delay: int_list(),
    visual_feedback: bool(true),
    reward_command_failure: float(0.0),
    reward_command_success: float(0.0),
    ;
    /// Size of the agent. The grid ids have the parameter, but the original draws their agent at its default scale.
    agent_scale: f64 = match variant.locomotion {
        Locomotion::Grid => 0.25,
        _ => given.float("agent_scale", 0.25),
    },
    /// Tiles along a side of the arena, 2 to 6.
    arena_size: i32 = given.int("arena_size", ENDLESS_ARENA_SIZE) as i32,
    /// Number of [commands](super::Command) that may occur, counted from the first; 4 to 9.
    allowed_commands: usize = given.int("allowed_commands", COMMANDS as i64) as usize,
    /// Commands at the start of an episode of the endless id.
    initial_command_count: usize = given.int("initial_command_count", 1) as usize,
    /// `reward_episode_success`, or `reward_new_command_success` of the endless id: reward for executing the whole sequence.
    reward_sequence_success: f64 =
        given.float("reward_episode_success", 0.0) + given.float("reward_new_command_success", 0.0),
}
