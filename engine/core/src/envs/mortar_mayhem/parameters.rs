//! The ids of Mortar Mayhem and their reset parameters.
//!
//! Source: `default_reset_parameters` and `process_reset_params` of the original. Where the original checks nothing, the limits
//! are ours: wide enough for every use, narrow enough that no value makes the rules meaningless or the memory large.

use crate::envs::{ActionSpace, Column, Family, InfoColumn, Parameter, ResetParameters, Spec};

use super::commands::{COMMANDS, MAX_VECTOR_COMMANDS};

/// How the agent moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Locomotion {
    /// By `agent_speed` in eight directions, held back by the arena's border.
    Free,
    /// The same, but leaving the screen on one side leads to the other.
    Wrapping,
    /// Turning and walking from tile to tile.
    Grid,
}

/// What tells the ids of the family apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Variant {
    pub locomotion: Locomotion,
    /// The commands are given as a vector observation and never shown.
    pub commands_given: bool,
    /// The sequence of commands grows until the agent fails.
    pub endless: bool,
    /// The agent starts up to two pixels off its tile's centre.
    pub start_offset: bool,
}

/// One set of reset parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    pub max_steps: i64,
    pub agent_scale: f64,
    pub agent_speed: f64,
    pub arena_size: i32,
    pub allowed_commands: usize,
    pub command_count: Vec<i64>,
    pub initial_command_count: usize,
    pub command_show_duration: Vec<i64>,
    pub command_show_delay: Vec<i64>,
    pub explosion_duration: Vec<i64>,
    pub explosion_delay: Vec<i64>,
    pub visual_feedback: bool,
    pub reward_command_failure: f64,
    pub reward_command_success: f64,
    /// `reward_episode_success`, or `reward_new_command_success` of the endless id: for completing a whole sequence.
    pub reward_sequence_success: f64,
}

/// Tiles along a side of the endless arena, which fills the screen.
const ENDLESS_ARENA_SIZE: i64 = 6;

impl Parameters {
    /// Reads the parameters of the family out of a checked set.
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

/// Largest scale of the agent: a radius of 100 pixels.
pub const MAX_AGENT_SCALE: f64 = 4.0;
/// Most steps that anything takes.
pub const MAX_DURATION: i64 = 1000;

const AGENT_SCALE: Parameter = Parameter::float(
    "agent_scale",
    0.25,
    0.0,
    4.0,
    "Size of the agent; 0.25 is a radius of 6 pixels. Without effect on a grid.",
);
const AGENT_SPEED: Parameter =
    Parameter::float("agent_speed", 3.0, 0.0, 84.0, "Speed of the agent in pixels per step.");
const ARENA_SIZE: Parameter = Parameter::int("arena_size", 5, 2, 6, "Tiles along a side of the arena.");
const ALLOWED_COMMANDS: &str = "How many of the commands may occur, in the order right, down, left, up, stay, right down, \
                                right up, left down, left up.";
const COMMAND_COUNT: &str = "Number of commands to execute. A list to draw from.";
const COMMAND_SHOW_DURATION: Parameter = Parameter::list(
    "command_show_duration",
    &[3],
    0,
    MAX_DURATION,
    "Steps that one command is shown. A list to draw from.",
);
const COMMAND_SHOW_DELAY: Parameter = Parameter::list(
    "command_show_delay",
    &[1],
    0,
    MAX_DURATION,
    "Steps between two shown commands. A list to draw from.",
);
const EXPLOSION_DURATION: &str = "Steps that the agent has to stay on the commanded tile. A list to draw from.";
const EXPLOSION_DELAY: &str = "Steps that the agent has to execute one command. A list to draw from.";
const VISUAL_FEEDBACK: Parameter =
    Parameter::bool("visual_feedback", true, "Whether the wrong tiles turn red when a command is checked.");
const REWARD_COMMAND_FAILURE: Parameter =
    Parameter::reward("reward_command_failure", 0.0, "Reward for failing at the current command.");
const REWARD_COMMAND_SUCCESS: Parameter =
    Parameter::reward("reward_command_success", 0.1, "Reward for executing one command.");
const REWARD_EPISODE_SUCCESS: Parameter =
    Parameter::reward("reward_episode_success", 0.0, "Reward for executing the whole sequence.");

const fn finite_command_count(max: i64) -> Parameter {
    Parameter::list("command_count", &[10], 1, max, COMMAND_COUNT)
}

const MORTAR_MAYHEM: &[Parameter] = &[
    AGENT_SCALE,
    AGENT_SPEED,
    ARENA_SIZE,
    Parameter::int("allowed_commands", 9, 4, 9, ALLOWED_COMMANDS),
    finite_command_count(1000),
    COMMAND_SHOW_DURATION,
    COMMAND_SHOW_DELAY,
    Parameter::list("explosion_duration", &[6], 1, MAX_DURATION, EXPLOSION_DURATION),
    Parameter::list("explosion_delay", &[18], 1, MAX_DURATION, EXPLOSION_DELAY),
    VISUAL_FEEDBACK,
    REWARD_COMMAND_FAILURE,
    REWARD_COMMAND_SUCCESS,
    REWARD_EPISODE_SUCCESS,
];

const MORTAR_MAYHEM_GRID: &[Parameter] = &[
    AGENT_SCALE,
    ARENA_SIZE,
    Parameter::int("allowed_commands", 5, 4, 9, ALLOWED_COMMANDS),
    finite_command_count(1000),
    COMMAND_SHOW_DURATION,
    COMMAND_SHOW_DELAY,
    Parameter::list("explosion_duration", &[2], 1, MAX_DURATION, EXPLOSION_DURATION),
    Parameter::list("explosion_delay", &[6], 1, MAX_DURATION, EXPLOSION_DELAY),
    VISUAL_FEEDBACK,
    REWARD_COMMAND_FAILURE,
    REWARD_COMMAND_SUCCESS,
    REWARD_EPISODE_SUCCESS,
];

const MORTAR_MAYHEM_B: &[Parameter] = &[
    AGENT_SCALE,
    AGENT_SPEED,
    ARENA_SIZE,
    Parameter::int("allowed_commands", 9, 4, 9, ALLOWED_COMMANDS),
    finite_command_count(MAX_VECTOR_COMMANDS as i64),
    Parameter::list("explosion_duration", &[6], 1, MAX_DURATION, EXPLOSION_DURATION),
    Parameter::list("explosion_delay", &[18], 1, MAX_DURATION, EXPLOSION_DELAY),
    VISUAL_FEEDBACK,
    REWARD_COMMAND_FAILURE,
    REWARD_COMMAND_SUCCESS,
    REWARD_EPISODE_SUCCESS,
];

const MORTAR_MAYHEM_B_GRID: &[Parameter] = &[
    AGENT_SCALE,
    ARENA_SIZE,
    Parameter::int("allowed_commands", 5, 4, 9, ALLOWED_COMMANDS),
    finite_command_count(MAX_VECTOR_COMMANDS as i64),
    Parameter::list("explosion_duration", &[2], 1, MAX_DURATION, EXPLOSION_DURATION),
    Parameter::list("explosion_delay", &[6], 1, MAX_DURATION, EXPLOSION_DELAY),
    VISUAL_FEEDBACK,
    REWARD_COMMAND_FAILURE,
    REWARD_COMMAND_SUCCESS,
    REWARD_EPISODE_SUCCESS,
];

const ENDLESS_MORTAR_MAYHEM: &[Parameter] = &[
    Parameter::int("max_steps", -1, i64::MIN, i64::MAX, "Steps that an episode may last; not limited if less than 1."),
    AGENT_SCALE,
    AGENT_SPEED,
    Parameter::int("allowed_commands", 9, 4, 9, ALLOWED_COMMANDS),
    Parameter::int("initial_command_count", 1, 1, 1000, "Commands that are shown at first."),
    COMMAND_SHOW_DURATION,
    COMMAND_SHOW_DELAY,
    Parameter::list("explosion_duration", &[6], 1, MAX_DURATION, EXPLOSION_DURATION),
    Parameter::list("explosion_delay", &[18], 1, MAX_DURATION, EXPLOSION_DELAY),
    VISUAL_FEEDBACK,
    REWARD_COMMAND_FAILURE,
    REWARD_COMMAND_SUCCESS,
    Parameter::reward("reward_new_command_success", 0.0, "Reward for executing the whole sequence known so far."),
];

const FINITE_INFO: &[InfoColumn] = &[
    InfoColumn {
        name: "success",
        is_integer: true,
        description: "1 if the last command was reached, as the original counts it: also if it failed",
    },
    InfoColumn {
        name: "commands_completed",
        is_integer: false,
        description: "share of the commands that were executed, 0 to 1",
    },
];

const ENDLESS_INFO: &[InfoColumn] = &[
    InfoColumn { name: "commands_completed", is_integer: true, description: "commands executed in the episode" },
    InfoColumn {
        name: "max_command_sequence",
        is_integer: true,
        description: "length of the longest sequence executed",
    },
];

/// What the frame shows. The place of each column is used by [`super::features`].
pub const FEATURES: &[Column] = &[
    Column { name: "agent_x", description: "x of the agent's centre as a share of the screen's width" },
    Column { name: "agent_y", description: "y of the agent's centre as a share of the screen's height" },
    Column { name: "heading_x", description: "x of the unit vector that the agent faces along" },
    Column { name: "heading_y", description: "y of the unit vector that the agent faces along" },
    Column { name: "command_right", description: "1 while this command is shown" },
    Column { name: "command_down", description: "1 while this command is shown" },
    Column { name: "command_left", description: "1 while this command is shown" },
    Column { name: "command_up", description: "1 while this command is shown" },
    Column { name: "command_stay", description: "1 while this command is shown" },
    Column { name: "command_right_down", description: "1 while this command is shown" },
    Column { name: "command_right_up", description: "1 while this command is shown" },
    Column { name: "command_left_down", description: "1 while this command is shown" },
    Column { name: "command_left_up", description: "1 while this command is shown" },
    Column { name: "burning", description: "1 while tiles are red" },
    Column { name: "safe_x", description: "column of the tile that is not red, divided by 5; 0 while none is red" },
    Column { name: "safe_y", description: "row of the tile that is not red, divided by 5; 0 while none is red" },
    Column { name: "arena_size", description: "tiles along a side of the arena, divided by 6" },
];

/// The five ids of the family.
pub const SPECS: &[Spec] = &[
    Spec {
        id: "MortarMayhem-v0",
        summary: "Memorise a sequence of shown commands, then walk it tile by tile",
        family: Family::MortarMayhem(Variant {
            locomotion: Locomotion::Free,
            commands_given: false,
            endless: false,
            start_offset: false,
        }),
        action_space: ActionSpace::multi_discrete(&[3, 3]),
        vector_observation: 0,
        ground_truth: 0,
        info: FINITE_INFO,
        features: FEATURES,
        parameters: MORTAR_MAYHEM,
        render_fps: 25,
    },
    Spec {
        id: "MortarMayhem-Grid-v0",
        summary: "Mortar Mayhem with turning and walking from tile to tile",
        family: Family::MortarMayhem(Variant {
            locomotion: Locomotion::Grid,
            commands_given: false,
            endless: false,
            start_offset: false,
        }),
        action_space: ActionSpace::Discrete(4),
        vector_observation: 0,
        ground_truth: 0,
        info: FINITE_INFO,
        features: FEATURES,
        parameters: MORTAR_MAYHEM_GRID,
        render_fps: 6,
    },
    Spec {
        id: "MortarMayhemB-v0",
        summary: "Mortar Mayhem without memory: the commands are always observed as a vector",
        family: Family::MortarMayhem(Variant {
            locomotion: Locomotion::Free,
            commands_given: true,
            endless: false,
            start_offset: true,
        }),
        action_space: ActionSpace::multi_discrete(&[3, 3]),
        vector_observation: MAX_VECTOR_COMMANDS * COMMANDS,
        ground_truth: 0,
        info: FINITE_INFO,
        features: FEATURES,
        parameters: MORTAR_MAYHEM_B,
        render_fps: 25,
    },
    Spec {
        id: "MortarMayhemB-Grid-v0",
        summary: "Mortar Mayhem without memory, on a grid",
        family: Family::MortarMayhem(Variant {
            locomotion: Locomotion::Grid,
            commands_given: true,
            endless: false,
            start_offset: false,
        }),
        action_space: ActionSpace::Discrete(4),
        vector_observation: MAX_VECTOR_COMMANDS * COMMANDS,
        ground_truth: 0,
        info: FINITE_INFO,
        features: FEATURES,
        parameters: MORTAR_MAYHEM_B_GRID,
        render_fps: 1,
    },
    Spec {
        id: "Endless-MortarMayhem-v0",
        summary: "Each time the sequence is executed it grows by one shown command, until the agent fails",
        family: Family::MortarMayhem(Variant {
            locomotion: Locomotion::Wrapping,
            commands_given: false,
            endless: true,
            start_offset: true,
        }),
        action_space: ActionSpace::multi_discrete(&[3, 3]),
        vector_observation: 0,
        ground_truth: 2,
        info: ENDLESS_INFO,
        features: FEATURES,
        parameters: ENDLESS_MORTAR_MAYHEM,
        render_fps: 25,
    },
];
