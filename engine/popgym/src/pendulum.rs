//! Position Only and Noisy Position Only Pendulum: swing a pendulum up, seeing only its angle.

use std::f64::consts::PI;
use std::hint::black_box;

use endless_gym_core::envs::{
    ActionSpace, Column, EnvSpec, Expert, ObservationSpace, OriginalTypes, Parameter, ResetParameters, RewardType,
    StatePart, StateSpace, Task, Transition, box_action,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;
use serde::{Deserialize, Serialize};

use crate::filter::{Filter, MAX_LENGTH, NOISE, noise, variance};
use crate::ids::levels;
use crate::pictures;

/// The last is only for noisy ones.
const ARGUMENTS: &[Parameter] =
    &[Parameter::float("g", 10.0, -1000.0, 1000.0, "acceleration by gravity, m/s²"), MAX_LENGTH, NOISE];
const PARAMETERS: &[Parameter] = &[
    Parameter::float("x_init", PI, 0.0, 100.0, "Bound of the first angle, rad: it is drawn from -x_init to x_init."),
    Parameter::float("y_init", 1.0, 0.0, 8.0, "Bound of the first angular velocity, rad/s."),
];

// Gymnasium's Pendulum-v1, in SI units.
const MAX_SPEED: f64 = 8.0;
const MAX_TORQUE: f32 = 2.0;
const SECONDS: f64 = 0.05;
/// Acceleration by torque: 3 / (m l²).
const TORQUE: f32 = 3.0;
/// Half the range of Gymnasium's rewards, which POPGym maps to -1..1.
const HALF_RANGE: f64 = 16.2736044 / 2.0;

/// What is observed, and the length of an episode.
pub struct Parameters {
    /// Standard deviation of the noise.
    noise: Option<f64>,
    /// Acceleration by gravity: 3 g / (2 l).
    gravity: f64,
    length: u32,
    x_init: f64,
    y_init: f64,
}

/// The state of an episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Pendulum {
    angle: f64,
    velocity: f64,
    observation: [f32; 2],
    steps: u32,
}

impl Pendulum {
    /// Moves on by one step. Every operation rounds as in Gymnasium.
    fn swing(&mut self, torque: f32, gravity: f64) {
        let velocity = self.velocity + (gravity * self.angle.sin() + f64::from(TORQUE * torque)) * SECONDS;
        self.velocity = velocity.clamp(-MAX_SPEED, MAX_SPEED);
        self.angle += self.velocity * SECONDS;
    }

    fn observe(&mut self, parameters: &Parameters, random: &mut Generator) {
        self.observation = [self.angle.cos() as f32, self.angle.sin() as f32];
        if let Some(deviation) = parameters.noise {
            for number in &mut self.observation {
                *number = (*number + random.normal(0.0, deviation) as f32).clamp(-1.0, 1.0);
            }
        }
    }
}

/// A square as the power of the mathematical library, which numpy calls for `x ** 2`. Its last bit may differ from that of
/// `x * x`, by which compilers replace a constant power.
fn square(x: f64) -> f64 {
    x.powf(black_box(2.0))
}

impl Task for Pendulum {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const FEATURES: &[Column] = &[
            Column { name: "cos", description: "cosine of the angle from the upright position" },
            Column { name: "sin", description: "sine of the angle" },
        ];
        const STATE: &[StatePart] = &[StatePart {
            name: "motion",
            description: "cosine and sine of the angle from the upright position, angular velocity, rad/s",
            space: StateSpace::Box { low: &[-1.0, -1.0, -MAX_SPEED as f32], high: &[1.0, 1.0, MAX_SPEED as f32] },
            shape: &[3],
            dtype: "float32",
        }];
        let types = OriginalTypes { reward: RewardType::NumpyFloat, ..OriginalTypes::DEFAULT };
        let summary = "Swing a pendulum up, seeing only its angle";
        EnvSpec {
            markov_state: STATE,
            types,
            features: FEATURES,
            observation_space: Some(ObservationSpace::Box { low: &[-1.0; 2], high: &[1.0; 2] }),
            parameters: PARAMETERS,
            arguments: &ARGUMENTS[..2],
            render_fps: 30,
            ..EnvSpec::new("PositionOnlyPendulum", summary, ActionSpace::bounded(&[-MAX_TORQUE], &[MAX_TORQUE]))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        let noisy = EnvSpec {
            id: "NoisyPositionOnlyPendulum",
            summary: "Swing a pendulum up, seeing only its angle, with noise",
            arguments: ARGUMENTS,
            ..Self::spec()
        };
        let positions = levels::<Self>(Self::spec(), ["", "max_episode_length=150", "max_episode_length=100"]);
        [positions, levels::<Self>(noisy, ["", "noise_sigma=0.2", "noise_sigma=0.3"])].concat()
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        Parameters {
            noise: noise(given),
            gravity: 3.0 * given.float("g", 10.0) / 2.0,
            length: given.int(MAX_LENGTH.name, 1) as u32,
            x_init: given.float("x_init", PI),
            y_init: given.float("y_init", 1.0),
        }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        let [angle, velocity] = [parameters.x_init, parameters.y_init].map(|bound| random.uniform(-bound, bound));
        *self = Pendulum { angle, velocity, ..Pendulum::default() };
        self.observe(parameters, random);
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], random: &mut Generator) -> Transition {
        // Every operation rounds as in Gymnasium; torque and its cost are float32.
        let torque = box_action(action)[0].clamp(-MAX_TORQUE, MAX_TORQUE);
        let torque_cost = 0.001 * torque.powf(black_box(2.0));
        let angle = (self.angle + PI).rem_euclid(2.0 * PI) - PI;
        let cost = square(angle) + 0.1 * square(self.velocity) + f64::from(torque_cost);
        self.swing(torque, parameters.gravity);
        self.steps = self.steps.saturating_add(1);
        self.observe(parameters, random);
        let reward = (-cost + HALF_RANGE) / HALF_RANGE / f64::from(parameters.length);
        Transition { reward, terminated: false, truncated: self.steps >= parameters.length }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        out.copy_from_slice(&self.observation);
    }

    fn markov_state(&self, _: &Parameters, out: &mut [f32]) {
        out.copy_from_slice(&[self.angle.cos(), self.angle.sin(), self.velocity].map(|number| number as f32));
    }

    fn paint(&self, _: &Parameters, canvas: &mut Canvas<'_>) {
        canvas.fill(pictures::DARK);
        let [cos, sin] = self.observation.map(f64::from);
        // The angle grows anticlockwise.
        let end = (42 - (32.0 * sin).round() as i32, 42 - (32.0 * cos).round() as i32);
        canvas.draw_line(pictures::GOLD, (42, 42), end, 6);
        canvas.draw_circle(pictures::PAPER, (42, 42), 4, 0);
        canvas.draw_circle(pictures::RED, end, 6, 0);
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        // The bound of the sum of so many steps and their rounding.
        let bound = parameters.x_init + (f64::from(self.steps) + 1.0) * MAX_SPEED * SECONDS;
        let max_speed = if self.steps == 0 { parameters.y_init } else { MAX_SPEED };
        // Another mathematical library may round differently.
        let shows = |number: f32, of: f64| parameters.noise.is_some() || (number - of as f32).abs() < 1e-6;
        self.angle.abs() <= bound
            && self.velocity.abs() <= max_speed
            && self.observation.iter().all(|number| number.abs() <= 1.0)
            && shows(self.observation[0], self.angle.cos())
            && shows(self.observation[1], self.angle.sin())
    }

    fn expert(parameters: &Parameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(Swing {
            gravity: parameters.gravity,
            variance: variance(parameters.noise),
            estimate: Pendulum::default(),
            filter: Filter::new(0.0, 0.0),
            last: None,
        }))
    }
}

/// Gives the pendulum the energy of the upright position, and balances it there. Estimates its motion from the observed angles.
struct Swing {
    gravity: f64,
    /// Variance of the observed cosine and sine.
    variance: f64,
    estimate: Pendulum,
    filter: Filter,
    /// The last torque.
    last: Option<f32>,
}

impl Swing {
    /// See [`Filter::predict`].
    const GROWTH: f64 = 1.15;
}

impl Expert for Swing {
    fn reset(&mut self) {
        self.last = None;
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        let [cos, sin] = [features[0], features[1]].map(f64::from);
        if let Some(last) = self.last {
            self.filter.predict(self.gravity * self.estimate.angle.cos(), SECONDS, Self::GROWTH);
            self.estimate.swing(last, self.gravity);
            let error = sin * self.estimate.angle.cos() - cos * self.estimate.angle.sin();
            let [angle, velocity] = self.filter.correct(self.variance);
            self.estimate.angle += angle * error;
            self.estimate.velocity += velocity * error;
        } else {
            // The velocity is at first uniform in ±1.
            self.filter = Filter::new(self.variance, 1.0 / 3.0);
            self.estimate = Pendulum { angle: sin.atan2(cos), ..Pendulum::default() };
        }
        let angle = (self.estimate.angle + PI).rem_euclid(2.0 * PI) - PI;
        let velocity = self.estimate.velocity;
        let energy = velocity * velocity / 2.0 + self.gravity * (angle.cos() - 1.0);
        let torque = if angle.abs() < 1.0 {
            -15.0 * angle - 4.0 * velocity
        } else {
            // A pendulum at rest is pushed, too.
            -10.0 * energy * if velocity < 0.0 { -1.0 } else { 1.0 }
        };
        let torque = (torque as f32).clamp(-MAX_TORQUE, MAX_TORQUE);
        self.last = Some(torque);
        action[0] = torque.to_bits().cast_signed();
    }
}
