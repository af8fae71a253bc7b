//! Environments of one's own for the tests: a small frame with unnamed actions, features only, and a box. The tests replace the
//! library that `endless new` writes by this file.

use endless_gym::envs::{ActionBranch, ActionSpace, Choice, Column, EnvSpec, ResetParameters, Task, Transition};
use endless_gym::pool::{Registry, RegistryError};
use endless_gym::random::Generator;
use endless_gym::raster::{Canvas, FrameShape, Rect};
use serde::{Deserialize, Serialize};

/// Steps after which every episode is truncated.
pub const STEPS: u32 = 5;

pub fn registry() -> Result<Registry, RegistryError> {
    Registry::new().with::<Small>()?.with::<Numbers>()?.with::<Slider>()
}

#[cfg(target_arch = "wasm32")]
endless_gym_web::module!(registry());

const NUMBERS: &[ActionBranch] = &[
    ActionBranch { name: "move", choices: &[choice("stay"), choice("left"), choice("right")] },
    ActionBranch {
        name: "lamp",
        choices: &[choice("off"), choice("red"), choice("green"), choice("blue"), choice("white")],
    },
];
const NUMBERS_FEATURES: &[Column] =
    &[Column { name: "move", description: "last move" }, Column { name: "lamp", description: "last lamp" }];

const fn choice(name: &'static str) -> Choice {
    Choice { name, description: "" }
}

macro_rules! task {
    ($name:ident, $spec:expr, $frame_or_features:item) => {
        #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
        pub struct $name {
            steps: u32,
            action: Vec<i32>,
        }

        impl Task for $name {
            type Parameters = ();

            fn spec() -> EnvSpec {
                $spec
            }

            fn parameters(_: &ResetParameters) {}

            fn reset(&mut self, _: &(), _: &mut Generator) {
                *self = $name::default();
            }

            fn step(&mut self, _: &(), action: &[i32], _: &mut Generator) -> Transition {
                *self = $name { steps: self.steps + 1, action: action.to_vec() };
                Transition { reward: 1.0, terminated: false, truncated: self.steps == STEPS }
            }

            fn is_valid(&self, _: &()) -> bool {
                self.steps == 0 && self.action.is_empty() || Self::spec().action_space.check(1, &self.action).is_ok()
            }

            $frame_or_features
        }
    };
}

task!(
    Small,
    EnvSpec {
        frame: Some(FrameShape::rgb(12, 12)),
        ..EnvSpec::new("Small-v0", "A small frame", ActionSpace::Discrete(4))
    },
    fn paint(&self, _: &(), canvas: &mut Canvas<'_>) {
        canvas.draw_rect([200; 3], Rect::new(self.action.first().copied().unwrap_or(0), 0, 2, 2), 0);
    }
);

task!(
    Numbers,
    EnvSpec {
        actions: NUMBERS,
        features: NUMBERS_FEATURES,
        ..EnvSpec::new("Numbers-v0", "Features only", ActionSpace::multi_discrete(&[3, 5]))
    },
    fn features(&self, _: &(), out: &mut [f32]) {
        out.iter_mut().zip(&self.action).for_each(|(out, number)| *out = *number as f32);
    }
);

task!(
    Slider,
    EnvSpec {
        frame: Some(FrameShape::rgb(20, 8)),
        ..EnvSpec::new("Slider-v0", "A box", ActionSpace::bounded(&[-1.0, f32::NEG_INFINITY], &[2.0, f32::INFINITY]))
    },
    fn paint(&self, _: &(), canvas: &mut Canvas<'_>) {
        let first = self.action.first().map_or(0.0, |bits| f32::from_bits(bits.cast_unsigned()));
        canvas.draw_rect([200; 3], Rect::new((first * 10.0) as i32, 2, 2, 2), 0);
    }
);
