//! The T-maze: remember the cue at the start of a corridor until the junction at its end.

use endless_gym::envs::{
    ActionBranch, ActionSpace, Choice, Column, EnvSpec, InfoColumn, Parameter, ResetParameters, Task, Transition,
};
use endless_gym::random::Generator;
use endless_gym::raster::{Canvas, FrameShape, Rect};
use serde::{Deserialize, Serialize};

const LEFT: i32 = 0;
const RIGHT: i32 = 1;
const AHEAD: i32 = 2;

const ACTIONS: &[ActionBranch] = &[ActionBranch {
    name: "move",
    choices: &[
        Choice { name: "left", description: "at the junction, turns left; elsewhere, stays" },
        Choice { name: "right", description: "at the junction, turns right; elsewhere, stays" },
        Choice { name: "ahead", description: "walks one cell ahead; at the junction, stays" },
    ],
}];

const PARAMETERS: &[Parameter] = &[
    Parameter::int("length", 10, 1, 80, "Cells from the start to the junction."),
    Parameter::int("max_steps", 100, 1, 10_000, "Steps after which the episode is truncated."),
];

const FEATURES: &[Column] = &[
    Column { name: "cue", description: "-1 left or 1 right, in the first step; later 0" },
    Column { name: "junction", description: "1 at the junction" },
];

const INFO: &[InfoColumn] =
    &[InfoColumn { name: "success", is_integer: true, description: "1 if the agent turned to the side of the cue" }];

/// The reset parameters.
pub struct Parameters {
    length: i64,
    max_steps: i64,
}

/// The state of an episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TMaze {
    cue: i32,
    position: i64,
    steps: i64,
    success: bool,
}

impl Task for TMaze {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        EnvSpec {
            frame: Some(FrameShape::rgb(84, 84)),
            actions: ACTIONS,
            parameters: PARAMETERS,
            features: FEATURES,
            info: INFO,
            ..EnvSpec::new("TMaze-v0", "Remember the cue until the junction", ActionSpace::Discrete(3))
        }
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        Parameters { length: given.int("length", 10), max_steps: given.int("max_steps", 100) }
    }

    fn reset(&mut self, _: &Parameters, random: &mut Generator) {
        let cue = if random.integers(0, 2) == 0 { LEFT } else { RIGHT };
        *self = TMaze { cue, ..TMaze::default() };
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        let is_at_junction = self.position == parameters.length;
        let terminated = is_at_junction && action[0] != AHEAD;
        self.success = terminated && action[0] == self.cue;
        self.position += i64::from(!is_at_junction && action[0] == AHEAD);
        self.steps += 1;
        let reward = if self.success { 1.0 } else { [-0.01, -1.0][usize::from(terminated)] };
        Transition { reward, terminated, truncated: !terminated && self.steps == parameters.max_steps }
    }

    fn features(&self, parameters: &Parameters, out: &mut [f32]) {
        out[0] = if self.steps > 0 { 0.0 } else { [-1.0, 1.0][usize::from(self.cue == RIGHT)] };
        out[1] = f32::from(u8::from(self.position == parameters.length));
    }

    fn paint(&self, parameters: &Parameters, canvas: &mut Canvas<'_>) {
        let (length, position) = (parameters.length as i32, self.position as i32);
        canvas.draw_rect([90; 3], Rect::new(1, 40, length + 1, 3), 0);
        canvas.draw_rect([90; 3], Rect::new(1 + length, 30, 1, 23), 0);
        canvas.draw_rect([255, 255, 0], Rect::new(1 + position, 41, 1, 1), 0);
        if self.steps == 0 {
            canvas.draw_rect([0, 255, 0], Rect::new(1, if self.cue == LEFT { 10 } else { 70 }, 8, 8), 0);
        }
    }

    fn info(&self, _: &Parameters, out: &mut [f64]) {
        out[0] = f64::from(u8::from(self.success));
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        // Without auto-reset, steps go on after the end; the limit keeps them from overflowing.
        [LEFT, RIGHT].contains(&self.cue)
            && (0..=parameters.length).contains(&self.position)
            && (self.position..=i64::from(u32::MAX)).contains(&self.steps)
            && (!self.success || self.position == parameters.length)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trainers_can_rely_on_it() {
        endless_gym::conformance::assert_conforms::<TMaze>();
    }

    #[test]
    fn only_the_turn_to_the_cue_is_rewarded() {
        let parameters = Parameters { length: 3, max_steps: 9 };
        for (turn, reward) in [(LEFT, -1.0), (RIGHT, 1.0)] {
            let mut maze = TMaze { cue: RIGHT, position: 3, steps: 3, success: false };
            let end = maze.step(&parameters, &[turn], &mut Generator::from_seed(0));
            assert_eq!((end.reward, end.terminated), (reward, true));
        }
    }
}
