//! The reset parameters of Mortar Mayhem as typed values, their limits, and the variants of its ids.
//!
//! Source: `default_reset_parameters` and `process_reset_params` of the original.

use super::commands::COMMANDS;
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

/// Maximum scale of the agent: a radius of 100 pixels.
pub const MAX_AGENT_SCALE: f64 = 4.0;
/// Maximum duration and delay in steps.
pub const MAX_DURATION: i64 = 1000;
/// Maximum number of commands of an id that shows them.
pub const MAX_COMMANDS: i64 = 1000;

/// One set of reset parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    /// Maximum steps per episode; unlimited if less than 1.
    pub max_steps: i64,
    /// Size of the agent; 0.25 is a radius of 6 pixels. 0 to 4.
    pub agent_scale: f64,
    /// Pixels per step, 0 to 84. Unused on a grid.
    pub agent_speed: f64,
    /// Tiles along a side of the arena, 2 to 6.
    pub arena_size: i32,
    /// Number of [commands](super::Command) that may occur, counted from the first; 4 to 9.
    pub allowed_commands: usize,
    /// Number of commands in an episode, to draw from; empty for the endless id.
    pub command_count: Vec<i64>,
    /// Commands at the start of an episode of the endless id.
    pub initial_command_count: usize,
    /// Steps that one command is shown, to draw from; empty if the commands are provided as a vector.
    pub command_show_duration: Vec<i64>,
    /// Steps between two shown commands, to draw from; empty if the commands are provided as a vector.
    pub command_show_delay: Vec<i64>,
    /// Steps that the tiles burn, to draw from; 1 to 1000.
    pub explosion_duration: Vec<i64>,
    /// Steps that the agent has for one command, to draw from; 1 to 1000.
    pub explosion_delay: Vec<i64>,
    /// Whether burning tiles are shown.
    pub visual_feedback: bool,
    /// Reward for failing at the current command.
    pub reward_command_failure: f64,
    /// Reward for executing one command.
    pub reward_command_success: f64,
    /// `reward_episode_success`, or `reward_new_command_success` of the endless id: reward for executing the whole sequence.
    pub reward_sequence_success: f64,
}

/// Tiles along a side of the endless arena, which fills the screen.
const ENDLESS_ARENA_SIZE: i64 = 6;

impl Parameters {
    /// Reads the parameters of the family from a checked set.
    pub fn new(variant: Variant, given: &ResetParameters) -> Self {
        Parameters {
            max_steps: given.int("max_steps", -1),
            // The grid ids have the parameter, but the original draws their agent at its default scale.
            agent_scale: match variant.locomotion {
                Locomotion::Grid => 0.25,
                _ => given.float("agent_scale", 0.25),
            },
            agent_speed: given.float("agent_speed", 0.0),
            arena_size: given.int("arena_size", ENDLESS_ARENA_SIZE) as i32,
            allowed_commands: given.int("allowed_commands", COMMANDS as i64) as usize,
            command_count: given.int_list("command_count"),
            initial_command_count: given.int("initial_command_count", 1) as usize,
            command_show_duration: given.int_list("command_show_duration"),
            command_show_delay: given.int_list("command_show_delay"),
            explosion_duration: given.int_list("explosion_duration"),
            explosion_delay: given.int_list("explosion_delay"),
            visual_feedback: given.bool("visual_feedback", true),
            reward_command_failure: given.float("reward_command_failure", 0.0),
            reward_command_success: given.float("reward_command_success", 0.0),
            reward_sequence_success: given.float("reward_episode_success", 0.0)
                + given.float("reward_new_command_success", 0.0),
        }
    }
}
