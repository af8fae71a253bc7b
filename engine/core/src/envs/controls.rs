//! The meaning of actions that several ids share.

use super::spec::{ActionBranch, Choice};

const fn choice(name: &'static str, description: &'static str) -> Choice {
    Choice { name, description }
}

/// Free movement, with a branch for each axis. Both together move diagonally, by the same distance.
pub(super) const MOVE: &[ActionBranch] = &[
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
pub(super) const TURN_AND_WALK: &[ActionBranch] = &[ActionBranch {
    name: "move",
    choices: &[
        choice("nothing", "no movement"),
        choice("left", "turns left by 90 degrees, and stays on its tile"),
        choice("right", "turns right by 90 degrees, and stays on its tile"),
        choice("ahead", "walks one tile ahead, except over the border"),
    ],
}];

/// Movement along a path that leads to the right.
pub(super) const FOLLOW: &[ActionBranch] = &[ActionBranch {
    name: "move",
    choices: &[
        choice("nothing", "no movement"),
        choice("right", "faces right and moves right"),
        choice("up", "faces up and moves up"),
        choice("down", "faces down and moves down"),
    ],
}];
