//! The ids of Mortar Mayhem, their reset parameters and their info columns.
//!
//! Source: `default_reset_parameters` of the original. The original checks few values. The limits here are wide enough for
//! every use, and narrow enough that no value breaks the rules or needs much memory.

use super::commands::{COMMANDS, MAX_VECTOR_COMMANDS};
use super::features::FEATURES;
use super::parameters::{Locomotion, MAX_AGENT_SCALE, MAX_COMMANDS, MAX_DURATION, Variant};
use crate::controls::{MOVE, TURN_AND_WALK};
use crate::screen::FRAME;
use endless_gym_core::envs::ActionSpace;
use endless_gym_core::envs::Parameter;
use endless_gym_core::envs::{Column, EnvSpec, InfoColumn};

const AGENT_SCALE: Parameter = Parameter::float(
    "agent_scale",
    0.25,
    0.0,
    MAX_AGENT_SCALE,
    "Size of the agent; 0.25 is a radius of 6 pixels. No effect on a grid.",
);
const AGENT_SPEED: Parameter =
    Parameter::float("agent_speed", 3.0, 0.0, 84.0, "Speed of the agent in pixels per step.");
const ARENA_SIZE: Parameter = Parameter::int("arena_size", 5, 2, 6, "Tiles along a side of the arena.");
const ALLOWED_COMMANDS: &str = "Number of different commands, from the start of this list: right, down, \
                                left, up, stay, right down, right up, left down, left up.";
const COMMAND_COUNT: &str = "Number of commands to execute. Each episode draws one from the list.";
const COMMAND_SHOW_DURATION: Parameter = Parameter::list(
    "command_show_duration",
    &[3],
    0,
    MAX_DURATION,
    "Steps for which a command is shown. Each episode draws one from the list.",
);
const COMMAND_SHOW_DELAY: Parameter = Parameter::list(
    "command_show_delay",
    &[1],
    0,
    MAX_DURATION,
    "Steps between two shown commands. Each episode draws one from the list.",
);
const EXPLOSION_DURATION: &str =
    "Steps for which the agent must stay on the commanded tile. Each episode draws one from the list.";
const EXPLOSION_DELAY: &str = "Steps that the agent has for one command. Each episode draws one from the list.";
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
    finite_command_count(MAX_COMMANDS),
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
    finite_command_count(MAX_COMMANDS),
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
    Parameter::int("max_steps", -1, i64::MIN, i64::MAX, "Maximum steps per episode; unlimited if less than 1."),
    AGENT_SCALE,
    AGENT_SPEED,
    Parameter::int("allowed_commands", 9, 4, 9, ALLOWED_COMMANDS),
    Parameter::int("initial_command_count", 1, 1, MAX_COMMANDS, "Commands at the start of an episode."),
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
        description: "1 if the last command was reached, even if the agent failed at it, as in the original",
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

const GROUND_TRUTH: &[Column] = &[
    Column {
        name: "target_x",
        description: "column of the tile that the current command leads to, from the left, divided by 5",
    },
    Column { name: "target_y", description: "row of that tile, from the top, divided by 5" },
];

/// The five ids of the family.
pub const IDS: &[(EnvSpec, Variant)] = &[
    (
        EnvSpec {
            id: "MortarMayhem-v0",
            summary: "Memorise a sequence of shown commands, then walk it tile by tile",
            action_space: ActionSpace::multi_discrete(&[3, 3]),
            frame: Some(FRAME),
            actions: MOVE,
            vector_observation: 0,
            ground_truth: &[],
            ground_truth_is_integer: false,
            ground_truth_bounds: Some((0.0, 1.0)),
            info: FINITE_INFO,
            features: FEATURES,
            observation_space: None,
            keeps_state: false,
            parameters: MORTAR_MAYHEM,
            render_fps: 25,
        },
        Variant { locomotion: Locomotion::Free, commands_given: false, endless: false, start_offset: false },
    ),
    (
        EnvSpec {
            id: "MortarMayhem-Grid-v0",
            summary: "Mortar Mayhem with turning and walking from tile to tile",
            action_space: ActionSpace::Discrete(4),
            frame: Some(FRAME),
            actions: TURN_AND_WALK,
            vector_observation: 0,
            ground_truth: &[],
            ground_truth_is_integer: false,
            ground_truth_bounds: Some((0.0, 1.0)),
            info: FINITE_INFO,
            features: FEATURES,
            observation_space: None,
            keeps_state: false,
            parameters: MORTAR_MAYHEM_GRID,
            render_fps: 6,
        },
        Variant { locomotion: Locomotion::Grid, commands_given: false, endless: false, start_offset: false },
    ),
    (
        EnvSpec {
            id: "MortarMayhemB-v0",
            summary: "Mortar Mayhem without memory: the commands are always observed as a vector",
            action_space: ActionSpace::multi_discrete(&[3, 3]),
            frame: Some(FRAME),
            actions: MOVE,
            vector_observation: MAX_VECTOR_COMMANDS * COMMANDS,
            ground_truth: &[],
            ground_truth_is_integer: false,
            ground_truth_bounds: Some((0.0, 1.0)),
            info: FINITE_INFO,
            features: FEATURES,
            observation_space: None,
            keeps_state: false,
            parameters: MORTAR_MAYHEM_B,
            render_fps: 25,
        },
        Variant { locomotion: Locomotion::Free, commands_given: true, endless: false, start_offset: true },
    ),
    (
        EnvSpec {
            id: "MortarMayhemB-Grid-v0",
            summary: "Mortar Mayhem without memory, on a grid",
            action_space: ActionSpace::Discrete(4),
            frame: Some(FRAME),
            actions: TURN_AND_WALK,
            vector_observation: MAX_VECTOR_COMMANDS * COMMANDS,
            ground_truth: &[],
            ground_truth_is_integer: false,
            ground_truth_bounds: Some((0.0, 1.0)),
            info: FINITE_INFO,
            features: FEATURES,
            observation_space: None,
            keeps_state: false,
            parameters: MORTAR_MAYHEM_B_GRID,
            render_fps: 1,
        },
        Variant { locomotion: Locomotion::Grid, commands_given: true, endless: false, start_offset: false },
    ),
    (
        EnvSpec {
            id: "Endless-MortarMayhem-v0",
            summary: "Each time the sequence is executed it grows by one shown command, until the agent fails",
            action_space: ActionSpace::multi_discrete(&[3, 3]),
            frame: Some(FRAME),
            actions: MOVE,
            vector_observation: 0,
            ground_truth: GROUND_TRUTH,
            ground_truth_is_integer: false,
            ground_truth_bounds: Some((0.0, 1.0)),
            info: ENDLESS_INFO,
            features: FEATURES,
            observation_space: None,
            keeps_state: true,
            parameters: ENDLESS_MORTAR_MAYHEM,
            render_fps: 25,
        },
        Variant { locomotion: Locomotion::Wrapping, commands_given: false, endless: true, start_offset: true },
    ),
];
