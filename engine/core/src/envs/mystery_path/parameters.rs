//! The ids of Mystery Path and their reset parameters.
//!
//! Source: `default_reset_parameters` and `process_reset_params` of the original. Where the original checks nothing, the limits
//! are ours: wide enough for every use, narrow enough that no value makes the rules meaningless or the memory large.

use super::features::{ENDLESS_FEATURES, FINITE_FEATURES};
use crate::envs::{ActionSpace, Family, InfoColumn, Parameter, ResetParameters, SCREEN, Spec};

/// What tells the ids of the family apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Variant {
    /// One screen with a goal; the agent moves by `agent_speed` in eight directions, held back by the screen's border.
    Free,
    /// The same, but the agent turns and walks from tile to tile.
    Grid,
    /// An endless way to the right, along which the screen scrolls; the agent moves right, up or down.
    Endless,
}

/// One set of reset parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    pub max_steps: i64,
    pub agent_scale: f64,
    pub agent_speed: f64,
    pub cardinal_origin_choice: Vec<i64>,
    pub show_origin: bool,
    pub show_goal: bool,
    pub show_past_path: bool,
    pub show_background: bool,
    pub show_stamina: bool,
    pub visual_feedback: bool,
    pub camera_offset_scale: f64,
    pub stamina_level: i64,
    pub reward_goal: f64,
    pub reward_fall_off: f64,
    pub reward_path_progress: f64,
    pub reward_path_progress_dense: f64,
    pub reward_step: f64,
}

impl Parameters {
    /// Reads the parameters of the family out of a checked set.
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
                // The original shows the endless way's origin if `show_origin` is true and false at once: never.
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

const DEFAULT_AGENT_SCALE: f64 = 0.25;

const fn max_steps(default: i64) -> Parameter {
    Parameter::int(
        "max_steps",
        default,
        i64::MIN,
        i64::MAX,
        "Steps that an episode may last; not limited if less than 1.",
    )
}

const fn reward_path_progress(default: f64) -> Parameter {
    Parameter::reward("reward_path_progress", default, "Reward for reaching a tile of the path for the first time.")
}

const AGENT_SCALE: Parameter = Parameter::float(
    "agent_scale",
    DEFAULT_AGENT_SCALE,
    0.0,
    4.0,
    "Size of the agent; 0.25 is a radius of 6 pixels. Without effect on a grid.",
);
// No step is longer than the screen, so that a step of the endless agent leads to the next segment at most.
const AGENT_SPEED: Parameter =
    Parameter::float("agent_speed", 3.0, 0.0, SCREEN as f64, "Speed of the agent in pixels per step.");
const CARDINAL_ORIGIN_CHOICE: Parameter = Parameter::list(
    "cardinal_origin_choice",
    &[0, 1, 2, 3],
    0,
    3,
    "Side of the screen where the path begins: 0 left, 1 right, 2 top, 3 bottom. A list to draw from.",
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
    Parameter::bool("show_origin", false, "Without effect, as in the original."),
    Parameter::bool("show_past_path", true, "Whether the path behind the agent is shown."),
    Parameter::bool("show_background", false, "Whether a tiled background scrolls with the agent."),
    Parameter::bool("show_stamina", false, "Whether a bar shows the steps that are left to make progress."),
    VISUAL_FEEDBACK,
    Parameter::float(
        "camera_offset_scale",
        5.0,
        -100.0,
        100.0,
        "Tiles to the left of the agent that are on the screen, held within 0 to 5.5; also, cut to a whole number, how \
         many columns of the past path are shown.",
    ),
    Parameter::int("stamina_level", 20, 1, 1_000_000_000, "Steps that the agent has to reach the next tile."),
    REWARD_FALL_OFF,
    reward_path_progress(0.1),
    Parameter::reward(
        "reward_path_progress_dense",
        0.0,
        "Reward for reaching a tile of the path for the first time since the last fall.",
    ),
    REWARD_STEP,
];

const NUM_FAILS: InfoColumn =
    InfoColumn { name: "num_fails", is_integer: true, description: "steps that the agent was found off the path" };

const FINITE_INFO: &[InfoColumn] = &[
    InfoColumn { name: "success", is_integer: true, description: "1 if the goal was reached, otherwise 0" },
    NUM_FAILS,
];

const ENDLESS_INFO: &[InfoColumn] = &[
    NUM_FAILS,
    InfoColumn {
        name: "max_x",
        is_integer: true,
        description: "the farthest column of the path that the agent was on, from 0",
    },
    InfoColumn {
        name: "tiles_visited",
        is_integer: true,
        description: "tiles of the path that the agent was on, without the first",
    },
];

/// The three ids of the family.
pub const SPECS: &[Spec] = &[
    Spec {
        id: "MysteryPath-v0",
        summary: "Find an invisible path to the goal; whoever falls off starts over and has to remember where",
        family: Family::MysteryPath(Variant::Free),
        action_space: ActionSpace::multi_discrete(&[3, 3]),
        vector_observation: 0,
        ground_truth: 0,
        info: FINITE_INFO,
        features: FINITE_FEATURES,
        parameters: MYSTERY_PATH,
        render_fps: 25,
    },
    Spec {
        id: "MysteryPath-Grid-v0",
        summary: "Mystery Path with turning and walking from tile to tile",
        family: Family::MysteryPath(Variant::Grid),
        action_space: ActionSpace::Discrete(4),
        vector_observation: 0,
        ground_truth: 0,
        info: FINITE_INFO,
        features: FINITE_FEATURES,
        parameters: MYSTERY_PATH_GRID,
        render_fps: 3,
    },
    Spec {
        id: "Endless-MysteryPath-v0",
        summary: "An invisible path without end; falling off before the farthest point, or twice at one place, ends it",
        family: Family::MysteryPath(Variant::Endless),
        action_space: ActionSpace::Discrete(4),
        vector_observation: 0,
        ground_truth: 3,
        info: ENDLESS_INFO,
        features: ENDLESS_FEATURES,
        parameters: ENDLESS_MYSTERY_PATH,
        render_fps: 25,
    },
];
