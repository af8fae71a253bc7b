//! What several ids share: the meaning of their actions, and parts of their specifications.

use endless_gym_core::envs::{ActionBranch, ActionSpace, Choice, Column, EnvSpec, InfoColumn, Parameter};

use crate::screen::{FRAME, SCREEN};

/// The specification of an id with frames, these actions, and a ground truth from 0 to 1.
pub(crate) fn spec(id: &'static str, summary: &'static str, actions: &'static [ActionBranch]) -> EnvSpec {
    let choices = |branch: &ActionBranch| branch.choices.len() as i32;
    let action_space = match actions {
        [branch] => ActionSpace::Discrete(choices(branch)),
        branches => ActionSpace::MultiDiscrete(branches.iter().map(choices).collect()),
    };
    let shared = EnvSpec::new(id, summary, action_space);
    EnvSpec { actions, frame: Some(FRAME), ground_truth_bounds: Some((0.0, 1.0)), ..shared }
}

/// The step limit of an id.
pub(crate) const fn max_steps(default: i64) -> Parameter {
    Parameter::int("max_steps", default, i64::MIN, i64::MAX, "Maximum steps per episode; unlimited if less than 1.")
}

/// Maximum scale of the agent: a radius of 100 pixels.
pub(crate) const MAX_AGENT_SCALE: f64 = 4.0;

/// The scale of an agent that some ids move on a grid.
pub(crate) const AGENT_SCALE: Parameter = Parameter::float(
    "agent_scale",
    0.25,
    0.0,
    MAX_AGENT_SCALE,
    "Size of the agent; 0.25 is a radius of 6 pixels. No effect on a grid.",
);

/// The speed of the agent. A step is at most as long as the screen is wide, so that the agent of an endless path never skips a segment.
pub(crate) const AGENT_SPEED: Parameter =
    Parameter::float("agent_speed", 3.0, 0.0, SCREEN as f64, "Speed of the agent in pixels per step.");

/// A column of the ground truth or of the features.
pub(crate) const fn column(name: &'static str, description: &'static str) -> Column {
    Column { name, description }
}

/// A column of the final info with a Python int.
pub(crate) const fn integer(name: &'static str, description: &'static str) -> InfoColumn {
    InfoColumn { name, is_integer: true, description }
}

/// A column of the final info with a float.
pub(crate) const fn float(name: &'static str, description: &'static str) -> InfoColumn {
    InfoColumn { name, is_integer: false, description }
}

const fn choice(name: &'static str, description: &'static str) -> Choice {
    Choice { name, description }
}

/// Free movement: a branch for each axis. Both together move diagonally, by the same distance.
pub(crate) const MOVE: &[ActionBranch] = &[
    ActionBranch {
        name: "horizontal",
        choices: &[
            choice("nothing", "no horizontal movement"),
            choice("left", "faces left and moves left"),
            choice("right", "faces right and moves right"),
        ],
    },
    ActionBranch {
        name: "vertical",
        choices: &[
            choice("nothing", "no vertical movement"),
            choice("up", "faces up and moves up"),
            choice("down", "faces down and moves down"),
        ],
    },
];

/// Turning and walking on a grid.
pub(crate) const TURN_AND_WALK: &[ActionBranch] = &[ActionBranch {
    name: "move",
    choices: &[
        choice("nothing", "no movement"),
        choice("left", "turns left by 90 degrees, and stays on its tile"),
        choice("right", "turns right by 90 degrees, and stays on its tile"),
        choice("ahead", "walks one tile ahead, except over the border"),
    ],
}];

/// Movement along a path that leads to the right.
pub(crate) const FOLLOW: &[ActionBranch] = &[ActionBranch {
    name: "move",
    choices: &[
        choice("nothing", "no movement"),
        choice("right", "faces right and moves right"),
        choice("up", "faces up and moves up"),
        choice("down", "faces down and moves down"),
    ],
}];

/// Actions on a grid.
const NOTHING: i32 = 0;
const LEFT: i32 = 1;
const RIGHT: i32 = 2;
const AHEAD: i32 = 3;

/// The grid action for a movement by `(x, y)` cells of an agent with that heading, a unit vector: horizontally first.
pub(crate) fn turn_or_walk([heading_x, heading_y]: [f32; 2], (x, y): (i32, i32)) -> i32 {
    let (wanted_x, wanted_y) = match (x, y) {
        (0, 0) => return NOTHING,
        (0, y) => (0.0, y.signum() as f32),
        (x, _) => (x.signum() as f32, 0.0),
    };
    let ahead = heading_x * wanted_x + heading_y * wanted_y;
    let clockwise = heading_x * wanted_y - heading_y * wanted_x;
    match () {
        _ if ahead > 0.5 => AHEAD,
        _ if clockwise > 0.5 => RIGHT,
        _ => LEFT,
    }
}
