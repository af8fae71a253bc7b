//! Environments for the tests of this crate.

use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

use crate::envs::{ActionSpace, Column, EnvSpec, InfoColumn, ResetParameters, StatePart, Task, TaskEnv, Transition};
use crate::pool::Registry;
use crate::random::Generator;
use crate::raster::{Canvas, FrameShape, Rect};

/// A square moves by its action from a random column, until it leaves the frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Toy {
    x: i32,
    steps: u32,
}

const FRAME: Option<FrameShape> = Some(FrameShape::rgb(84, 84));
const FEATURES: &[Column] =
    &[Column { name: "x", description: "column" }, Column { name: "steps", description: "steps" }];
const GROUND_TRUTH: &[Column] = &[Column { name: "x", description: "column, in 0..=1" }];
const STATE: &[StatePart] = &[StatePart::integer("x", 100, "column")];
const INFO: &[InfoColumn] = &[InfoColumn { name: "x", is_integer: true, description: "last column" }];

impl Task for Toy {
    type Parameters = ();

    fn spec() -> EnvSpec {
        let space = ActionSpace::Discrete(4);
        EnvSpec {
            frame: FRAME,
            features: FEATURES,
            ground_truth: GROUND_TRUTH,
            markov_state: STATE,
            info: INFO,
            ..EnvSpec::new("Toy-v0", "Leave", space)
        }
    }

    fn parameters(_: &ResetParameters) {}

    fn reset(&mut self, _: &(), random: &mut Generator) {
        *self = Toy { x: random.integers(0, 40) as i32, steps: 0 };
    }

    fn step(&mut self, _: &(), action: &[i32], random: &mut Generator) -> Transition {
        self.x += action[0] + random.integers(0, 3) as i32;
        self.steps += 1;
        Transition { reward: f64::from(self.x), terminated: self.x >= 84, ..Transition::default() }
    }

    fn features(&self, _: &(), out: &mut [f32]) {
        out.copy_from_slice(&[self.x as f32, self.steps as f32]);
    }

    fn paint(&self, _: &(), canvas: &mut Canvas<'_>) {
        canvas.draw_rect([200, 100, 50], Rect::new(self.x, 30, 10, 10), 0);
    }

    fn ground_truth(&self, _: &(), out: &mut [f64]) {
        out[0] = f64::from(self.x) / 84.0;
    }

    fn markov_state(&self, _: &(), out: &mut [f32]) {
        out[0] = self.x as f32;
    }

    fn info(&self, _: &(), out: &mut [f64]) {
        out[0] = f64::from(self.x);
    }

    fn is_valid(&self, _: &()) -> bool {
        self.x >= 0
    }
}

/// Ids with all sections (`Toy-v0`), with a vector and two branches (`Toy-Vector-v0`), and with nothing optional (`Toy-Plain-v0`). Only
/// the first is for playing.
pub(crate) fn toys() -> &'static Registry {
    static REGISTRY: LazyLock<Registry> = LazyLock::new(|| {
        let mut registry = Registry::new().with::<Toy>().unwrap();
        let two = EnvSpec::new("Toy-Vector-v0", "Two branches", ActionSpace::multi_discrete(&[3, 3]));
        let specs = [EnvSpec { frame: FRAME, vector_observation: 5, features: FEATURES, ..two }, plain()];
        for spec in specs {
            registry.register::<TaskEnv<Toy>>(spec, ()).unwrap();
        }
        registry
    });
    &REGISTRY
}

fn plain() -> EnvSpec {
    EnvSpec { frame: FRAME, ..EnvSpec::new("Toy-Plain-v0", "Nothing optional", ActionSpace::Discrete(2)) }
}
