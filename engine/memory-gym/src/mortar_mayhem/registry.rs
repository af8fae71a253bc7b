//! The ids of Mortar Mayhem, their reset parameters and their info columns.
//!
//! Source: `default_reset_parameters` of the original. The original checks few values. The limits here are wide enough for
//! every use, and narrow enough that no value breaks the rules or needs much memory.

use super::commands::{COMMANDS, MAX_VECTOR_COMMANDS};
use super::features::FEATURES;
use super::parameters::{Locomotion, MAX_COMMANDS, MAX_DURATION, Variant};
use std::sync::LazyLock;

use crate::controls::{AGENT_SCALE, AGENT_SPEED, MOVE, TURN_AND_WALK, column, float, integer, max_steps, spec};
use endless_gym_core::envs::{Column, EnvSpec, InfoColumn, Learnt, Metric, OriginalTypes, Parameter, RewardType};

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

/// The parameters of a finite id: the speed, if the agent moves freely; the default number of allowed commands; the largest number of
/// commands; what depends on their being shown; the default duration and delay of explosions.
macro_rules! finite {
    ([$($speed:expr)?], $allowed:expr, $max:expr, [$($shown:expr),*], $duration:expr, $delay:expr) => {
        &[
            AGENT_SCALE,
            $($speed,)?
            ARENA_SIZE,
            Parameter::int("allowed_commands", $allowed, 4, 9, ALLOWED_COMMANDS),
            Parameter::list("command_count", &[10], 1, $max, COMMAND_COUNT),
            $($shown,)*
            Parameter::list("explosion_duration", &[$duration], 1, MAX_DURATION, EXPLOSION_DURATION),
            Parameter::list("explosion_delay", &[$delay], 1, MAX_DURATION, EXPLOSION_DELAY),
            VISUAL_FEEDBACK,
            REWARD_COMMAND_FAILURE,
            REWARD_COMMAND_SUCCESS,
            REWARD_EPISODE_SUCCESS,
        ]
    };
}

const GIVEN: i64 = MAX_VECTOR_COMMANDS as i64;
const MORTAR_MAYHEM: &[Parameter] =
    finite!([AGENT_SPEED], 9, MAX_COMMANDS, [COMMAND_SHOW_DURATION, COMMAND_SHOW_DELAY], 6, 18);
const MORTAR_MAYHEM_GRID: &[Parameter] =
    finite!([], 5, MAX_COMMANDS, [COMMAND_SHOW_DURATION, COMMAND_SHOW_DELAY], 2, 6);
const MORTAR_MAYHEM_B: &[Parameter] = finite!([AGENT_SPEED], 9, GIVEN, [], 6, 18);
const MORTAR_MAYHEM_B_GRID: &[Parameter] = finite!([], 5, GIVEN, [], 2, 6);

const ENDLESS_MORTAR_MAYHEM: &[Parameter] = &[
    max_steps(-1),
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
    integer("success", "1 if the last command was reached, even if the agent failed at it, as in the original"),
    float("commands_completed", "share of the commands that were executed, 0 to 1"),
    InfoColumn {
        description: "share of the commands that were executed, 0 to 1, without a failed last command",
        ..InfoColumn::TASK_PROGRESS
    },
];

const ENDLESS_INFO: &[InfoColumn] = &[
    integer("commands_completed", "commands executed in the episode"),
    integer("max_command_sequence", "length of the longest sequence executed"),
];

const GROUND_TRUTH: &[Column] = &[
    column("target_x", "column of the tile that the current command leads to, from the left, divided by 5"),
    column("target_y", "row of that tile, from the top, divided by 5"),
];

const TYPES: OriginalTypes =
    OriginalTypes { integers: "int64", reward: RewardType::IntegerZeroUntilEnd, numpy_floats: &["commands_completed"] };

/// The five ids of the family.
pub static IDS: LazyLock<[(EnvSpec, Variant); 5]> = LazyLock::new(|| {
    let finite = |id, summary, actions, parameters| EnvSpec {
        info: FINITE_INFO,
        types: TYPES,
        features: FEATURES,
        parameters,
        metric: Metric::TASK_PROGRESS,
        learnt: Some(Learnt::by(InfoColumn::TASK_PROGRESS.name)),
        // The most commands, each shown and executed for the longest time.
        step_limit: |given| {
            let most = |name| given.int_list(name).into_iter().max().unwrap_or(0);
            let (shown, burning) =
                (most("command_show_duration") + most("command_show_delay"), most("explosion_duration"));
            Some((shown + burning + most("explosion_delay")) * most("command_count") - burning + 1)
        },
        ..spec(id, summary, actions)
    };
    let summary = "Memorise a sequence of shown commands, then walk it tile by tile";
    let free = finite("MortarMayhem-v0", summary, MOVE, MORTAR_MAYHEM);
    let summary = "Mortar Mayhem with turning and walking from tile to tile";
    let grid = finite("MortarMayhem-Grid-v0", summary, TURN_AND_WALK, MORTAR_MAYHEM_GRID);
    let summary = "Mortar Mayhem without memory: the commands are always observed as a vector";
    let given = finite("MortarMayhemB-v0", summary, MOVE, MORTAR_MAYHEM_B);
    let summary = "Mortar Mayhem without memory, on a grid";
    let given_grid = finite("MortarMayhemB-Grid-v0", summary, TURN_AND_WALK, MORTAR_MAYHEM_B_GRID);
    let summary = "Each time the sequence is executed it grows by one shown command, until the agent fails";
    let endless = spec("Endless-MortarMayhem-v0", summary, MOVE);
    let (features, parameters) = (FEATURES, ENDLESS_MORTAR_MAYHEM);
    let metric = Metric { name: "commands_completed", label: "Commands" };
    let endless = EnvSpec { features, parameters, metric, learnt: None, ..endless };
    let vector_observation = MAX_VECTOR_COMMANDS * COMMANDS;
    let variant = Variant { locomotion: Locomotion::Free, commands_given: false, endless: false, start_offset: false };
    let on_grid = Variant { locomotion: Locomotion::Grid, ..variant };
    [
        (free, variant),
        (EnvSpec { render_fps: 6, ..grid }, on_grid),
        (EnvSpec { vector_observation, ..given }, Variant { commands_given: true, start_offset: true, ..variant }),
        (EnvSpec { vector_observation, render_fps: 1, ..given_grid }, Variant { commands_given: true, ..on_grid }),
        (
            EnvSpec { ground_truth: GROUND_TRUTH, info: ENDLESS_INFO, types: TYPES, keeps_state: true, ..endless },
            Variant { locomotion: Locomotion::Wrapping, endless: true, start_offset: true, ..variant },
        ),
    ]
});
