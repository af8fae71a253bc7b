//! An environment of one's own, the T-maze, in a program that does with it all that `endless` does:
//!
//! ```console
//! cargo run --release --example t_maze list TMaze-v0
//! cargo run --release --example t_maze bench --env TMaze-v0
//! cargo run --release --example t_maze serve --env TMaze-v0 --num-envs 64 --features
//! ```

use std::process::ExitCode;

use endless_gym::envs::{
    ActionBranch, ActionSpace, Choice, Column, EnvSpec, InfoColumn, Parameter, Progress, ResetParameters, Task,
    Transition,
};
use endless_gym::memory_gym;
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
    Parameter::reward("reward_step", -0.01, "Reward for each step that ends no episode."),
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
    reward_step: f64,
}

/// A corridor with a cue at its start and a junction at its end: remember the cue until the junction.
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
        Parameters {
            length: given.int("length", 10),
            max_steps: given.int("max_steps", 100),
            reward_step: given.float("reward_step", -0.01),
        }
    }

    fn reset(&mut self, _: &Parameters, random: &mut Generator) {
        let cue = if random.integers(0, 2) == 0 { LEFT } else { RIGHT };
        *self = TMaze { cue, ..TMaze::default() };
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        self.steps += 1;
        match (action[0], self.position == parameters.length) {
            (AHEAD, false) => self.position += 1,
            (turn @ (LEFT | RIGHT), true) => {
                self.success = turn == self.cue;
                let reward = if self.success { 1.0 } else { -1.0 };
                return Transition { reward, terminated: true, truncated: false };
            }
            _ => {}
        }
        Transition { reward: parameters.reward_step, terminated: false, truncated: self.steps == parameters.max_steps }
    }

    fn features(&self, parameters: &Parameters, out: &mut [f32]) {
        out[0] = if self.steps == 0 { [-1.0, 1.0][usize::from(self.cue == RIGHT)] } else { 0.0 };
        out[1] = f32::from(u8::from(self.position == parameters.length));
    }

    fn paint(&self, parameters: &Parameters, canvas: &mut Canvas<'_>) {
        let length = parameters.length as i32;
        canvas.draw_rect([90; 3], Rect::new(1, 40, length + 1, 3), 0);
        canvas.draw_rect([90; 3], Rect::new(1 + length, 30, 1, 23), 0);
        canvas.draw_rect([255, 255, 0], Rect::new(1 + self.position as i32, 41, 1, 1), 0);
        if self.steps == 0 {
            let y = if self.cue == LEFT { 10 } else { 70 };
            canvas.draw_rect([0, 255, 0], Rect::new(1, y, 8, 8), 0);
        }
    }

    fn info(&self, _: &Parameters, out: &mut [f64]) {
        out[0] = f64::from(u8::from(self.success));
    }

    fn progress(&self) -> Vec<Progress> {
        vec![Progress::count("cells", self.position as f64)]
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        [LEFT, RIGHT].contains(&self.cue)
            && (0..=parameters.length).contains(&self.position)
            && (self.position..=parameters.max_steps).contains(&self.steps)
    }
}

fn main() -> ExitCode {
    match memory_gym().clone().with::<TMaze>() {
        Ok(registry) => endless_gym::program(&registry),
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
