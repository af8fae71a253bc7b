//! The ids of Mystery Path, their reset parameters and their info columns.
//!
//! Source: `default_reset_parameters` of the original. The original checks no values. The limits here are wide enough for every
//! use, and narrow enough that no value breaks the rules or needs much memory.

use super::features::{endless_features, finite_features};
use super::parameters::{MAX_STAMINA, Variant};
use std::sync::LazyLock;

use crate::controls::{AGENT_SCALE, AGENT_SPEED, FOLLOW, MOVE, TURN_AND_WALK, column, integer, max_steps, spec};
use endless_gym_core::envs::{Column, EnvSpec, InfoColumn, Metric, Parameter};

const fn reward_path_progress(default: f64) -> Parameter {
    Parameter::reward("reward_path_progress", default, "Reward for reaching a tile of the path for the first time.")
}

const CARDINAL_ORIGIN_CHOICE: Parameter = Parameter::list(
    "cardinal_origin_choice",
    &[0, 1, 2, 3],
    0,
    3,
    "Side of the screen where the path starts: 0 left, 1 right, 2 top, 3 bottom. Each episode draws one from the list.",
);
const SHOW_ORIGIN: Parameter = Parameter::bool("show_origin", false, "Whether the path's first tile is shown.");
const SHOW_GOAL: Parameter = Parameter::bool("show_goal", false, "Whether the path's last tile is shown.");
const VISUAL_FEEDBACK: Parameter =
    Parameter::bool("visual_feedback", true, "Whether a red cross on the agent shows that it fell off the path.");
const REWARD_GOAL: Parameter = Parameter::reward("reward_goal", 1.0, "Reward for reaching the goal.");
const REWARD_FALL_OFF: Parameter = Parameter::reward("reward_fall_off", 0.0, "Reward for falling off the path.");
const REWARD_STEP: Parameter = Parameter::reward("reward_step", 0.0, "Reward for each step.");

const MYSTERY_PATH: &[Parameter] = &[
    max_steps(512),
    AGENT_SCALE,
    AGENT_SPEED,
    CARDINAL_ORIGIN_CHOICE,
    SHOW_ORIGIN,
    SHOW_GOAL,
    VISUAL_FEEDBACK,
    REWARD_GOAL,
    REWARD_FALL_OFF,
    reward_path_progress(0.1),
    REWARD_STEP,
];

const MYSTERY_PATH_GRID: &[Parameter] = &[
    max_steps(128),
    AGENT_SCALE,
    CARDINAL_ORIGIN_CHOICE,
    SHOW_ORIGIN,
    SHOW_GOAL,
    VISUAL_FEEDBACK,
    REWARD_GOAL,
    REWARD_FALL_OFF,
    reward_path_progress(0.0),
    REWARD_STEP,
];

const ENDLESS_MYSTERY_PATH: &[Parameter] = &[
    max_steps(-1),
    AGENT_SCALE,
    AGENT_SPEED,
    Parameter::bool("show_origin", false, "No effect, as in the original."),
    Parameter::bool("show_past_path", true, "Whether the path behind the agent is shown."),
    Parameter::bool("show_background", false, "Whether a tiled background scrolls with the agent."),
    Parameter::bool("show_stamina", false, "Whether a bar shows the steps that are left to make progress."),
    VISUAL_FEEDBACK,
    Parameter::float(
        "camera_offset_scale",
        5.0,
        -100.0,
        100.0,
        "Number of tiles on the screen to the left of the agent, limited to 0 to 5.5. Truncated, it is also the number \
         of columns of the past path that are shown.",
    ),
    Parameter::int("stamina_level", 20, 1, MAX_STAMINA, "Maximum number of steps to reach the next tile."),
    REWARD_FALL_OFF,
    reward_path_progress(0.1),
    Parameter::reward(
        "reward_path_progress_dense",
        0.0,
        "Reward for reaching a tile of the path for the first time since the last fall.",
    ),
    REWARD_STEP,
];

const NUM_FAILS: InfoColumn = integer("num_fails", "steps in which the agent was off the path");

const FINITE_INFO: &[InfoColumn] = &[
    integer("success", "1 if the goal was reached, otherwise 0"),
    NUM_FAILS,
    InfoColumn {
        description: "share of the path's tiles that were reached, 0 to 1; `success` if they have no reward",
        ..InfoColumn::TASK_PROGRESS
    },
];

const ENDLESS_INFO: &[InfoColumn] = &[
    NUM_FAILS,
    integer("max_x", "the farthest column of the path that the agent was on, from 0"),
    integer("tiles_visited", "tiles of the path that the agent was on, not counting the first"),
];

const GROUND_TRUTH: &[Column] = &[
    column(
        "right",
        "1 if the path's next tile is to the right of the last one that the agent was on, otherwise 0. Where the path leads back to the left, the last direction remains",
    ),
    column("up", "1 if the next tile is above it, otherwise 0"),
    column("down", "1 if the next tile is below it, otherwise 0"),
];

/// The three ids of the family.
pub static IDS: LazyLock<[(EnvSpec, Variant); 3]> = LazyLock::new(|| {
    let summary = "Find an invisible path to the goal; the agent starts over after a fall and must remember the path";
    let free = spec("MysteryPath-v0", summary, MOVE);
    let grid = spec("MysteryPath-Grid-v0", "Mystery Path with turning and walking from tile to tile", TURN_AND_WALK);
    let summary = "Follow an endless invisible path; a fall before the farthest column, or twice at the same tile, ends the episode";
    let endless = spec("Endless-MysteryPath-v0", summary, FOLLOW);
    let (info, features, metric) = (FINITE_INFO, finite_features(), Metric::TASK_PROGRESS);
    [
        (EnvSpec { info, features, metric, parameters: MYSTERY_PATH, ..free }, Variant::Free),
        (EnvSpec { info, features, metric, parameters: MYSTERY_PATH_GRID, render_fps: 3, ..grid }, Variant::Grid),
        (
            EnvSpec {
                ground_truth: GROUND_TRUTH,
                ground_truth_is_integer: true,
                info: ENDLESS_INFO,
                features: endless_features(),
                parameters: ENDLESS_MYSTERY_PATH,
                metric: Metric { name: "tiles_visited", label: "Tiles" },
                learnt: None,
                ..endless
            },
            Variant::Endless,
        ),
    ]
});
