//! Position Only, Velocity Only and Noisy Position Only Cart Pole: balance a pole on a cart of which the observation shows half.

use std::f64::consts::PI;

use endless_gym_core::envs::{
    ActionBranch, ActionSpace, Choice, Column, EnvSpec, Expert, ObservationSpace, Parameter, ResetParameters,
    StatePart, StateSpace, Task, Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::{Canvas, Rect};
use serde::{Deserialize, Serialize};

use crate::filter::{Filter, MAX_LENGTH, NOISE, noise, variance};
use crate::ids::levels;
use crate::pictures;

/// The last is only for noisy ones.
const ARGUMENTS: &[Parameter] = &[
    Parameter::bool("sutton_barto_reward", false, "the reward is -1 until the pole falls, as the original maps it"),
    MAX_LENGTH,
    NOISE,
];
const PARAMETERS: &[Parameter] = &[
    Parameter::float(
        "low",
        -0.05,
        -1.0,
        0.0,
        "Lower bound of the first positions (m, rad) and velocities (m/s, rad/s).",
    ),
    Parameter::float("high", 0.05, 0.0, 1.0, "Upper bound of the first positions and velocities."),
];

// Gymnasium's CartPole-v1, in SI units.
const GRAVITY: f64 = 9.8;
const MASS_POLE: f64 = 0.1;
const TOTAL_MASS: f64 = 0.1 + 1.0;
/// Half the pole's length.
const LENGTH: f64 = 0.5;
const POLE_MOMENT: f64 = MASS_POLE * LENGTH;
const FORCE: f64 = 10.0;
const SECONDS: f64 = 0.02;
const MAX_X: f64 = 2.4;
const MAX_ANGLE: f64 = 12.0 * 2.0 * PI / 360.0;
/// Bounds of position, velocity, angle and angular velocity in an episode: the push cannot accelerate cart and pole any further on the way
/// from one limit to the other. After the end, they go on.
const BOUNDS: [f64; 4] = [MAX_X, 11.0, MAX_ANGLE, 6.0];
const BOUNDS_AFTER_END: [f64; 4] = [1e18, 1e9, 1e12, 1e3];
/// Bounds of the observed positions.
const HIGH: [f32; 2] = [(MAX_X * 2.0) as f32, (MAX_ANGLE * 2.0) as f32];

/// What is observed, and the length of an episode.
pub struct Parameters {
    velocities: bool,
    /// Standard deviation of the noise.
    noise: Option<f64>,
    length: u32,
    /// The rewards of a step in which nothing fails, of the first that fails, and of later ones, after the end.
    rewards: [f64; 3],
    low: f64,
    high: f64,
}

/// The state of an episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CartPole {
    x: f64,
    velocity: f64,
    angle: f64,
    angular_velocity: f64,
    observation: [f32; 2],
    steps: u32,
    /// Whether the pole has fallen or the cart has left the track.
    has_failed: bool,
}

impl CartPole {
    /// Pushes the cart. Every operation rounds as in Gymnasium.
    fn push(&mut self, action: i32) {
        let force = if action == 1 { FORCE } else { -FORCE };
        let (sin, cos) = (self.angle.sin(), self.angle.cos());
        let push = (force + POLE_MOMENT * (self.angular_velocity * self.angular_velocity) * sin) / TOTAL_MASS;
        let angular_acceleration =
            (GRAVITY * sin - cos * push) / (LENGTH * (4.0 / 3.0 - MASS_POLE * (cos * cos) / TOTAL_MASS));
        let acceleration = push - POLE_MOMENT * angular_acceleration * cos / TOTAL_MASS;
        self.x += SECONDS * self.velocity;
        self.velocity += SECONDS * acceleration;
        self.angle += SECONDS * self.angular_velocity;
        self.angular_velocity += SECONDS * angular_acceleration;
    }

    /// Observes two numbers, with noise.
    fn observe(&mut self, numbers: [f64; 2], parameters: &Parameters, random: &mut Generator) {
        self.observation = numbers.map(|number| number as f32);
        if let Some(deviation) = parameters.noise {
            for (number, high) in self.observation.iter_mut().zip(HIGH) {
                *number = (*number + random.normal(0.0, deviation) as f32).clamp(-high, high);
            }
        }
    }
}

impl Task for CartPole {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const ACTIONS: &[ActionBranch] = &[ActionBranch {
            name: "push",
            choices: &[
                Choice { name: "left", description: "pushes the cart to the left" },
                Choice { name: "right", description: "pushes the cart to the right" },
            ],
        }];
        const POSITIONS: &[Column] = &[
            Column { name: "position", description: "position of the cart, m" },
            Column { name: "angle", description: "angle of the pole, rad" },
        ];
        const STATE: &[StatePart] = &[StatePart {
            name: "motion",
            description: "position of the cart, m, its velocity, m/s, angle of the pole, rad, its angular velocity, rad/s",
            space: StateSpace::Box {
                low: &[-HIGH[0], f32::NEG_INFINITY, -HIGH[1], f32::NEG_INFINITY],
                high: &[HIGH[0], f32::INFINITY, HIGH[1], f32::INFINITY],
            },
            shape: &[4],
            dtype: "float32",
        }];
        let summary = "Balance a pole, seeing only positions";
        EnvSpec {
            actions: ACTIONS,
            features: POSITIONS,
            observation_space: Some(ObservationSpace::Box { low: &[-HIGH[0], -HIGH[1]], high: &HIGH }),
            markov_state: STATE,
            parameters: PARAMETERS,
            arguments: &ARGUMENTS[..2],
            render_fps: 50,
            ..EnvSpec::new("PositionOnlyCartPole", summary, ActionSpace::Discrete(2))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        const VELOCITIES: &[Column] = &[
            Column { name: "velocity", description: "velocity of the cart, m/s; at first its position, m" },
            Column {
                name: "angular_velocity",
                description: "angular velocity of the pole, rad/s; at first its angle, rad",
            },
        ];
        let (positions, lengths) = (Self::spec(), ["", "max_episode_length=400", "max_episode_length=600"]);
        let unbounded = ObservationSpace::Box { low: &[f32::NEG_INFINITY; 2], high: &[f32::INFINITY; 2] };
        let velocities = EnvSpec {
            id: "VelocityOnlyCartpole",
            summary: "Balance a pole, seeing only velocities",
            features: VELOCITIES,
            observation_space: Some(unbounded),
            ..positions.clone()
        };
        let noisy = EnvSpec {
            id: "NoisyPositionOnlyCartPole",
            summary: "Balance a pole, seeing only positions, with noise",
            arguments: ARGUMENTS,
            ..positions.clone()
        };
        let noises = ["", "noise_sigma=0.2", "noise_sigma=0.3"];
        [(positions, lengths), (velocities, lengths), (noisy, noises)]
            .map(|(spec, each)| levels::<Self>(spec, each))
            .concat()
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let length = given.int(MAX_LENGTH.name, 1) as u32;
        let good = 1.0 / f64::from(length);
        let rewards = if given.bool("sutton_barto_reward", false) { [-1.0, good, good] } else { [good, good, -1.0] };
        Parameters {
            velocities: given.id().contains("Velocity"),
            noise: noise(given),
            length,
            rewards,
            low: given.float("low", -0.05),
            high: given.float("high", 0.05),
        }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        let [x, velocity, angle, angular_velocity] = [(); 4].map(|()| random.uniform(parameters.low, parameters.high));
        *self = CartPole { x, velocity, angle, angular_velocity, ..CartPole::default() };
        // The original shows positions here, also where it later shows velocities.
        self.observe([x, angle], parameters, random);
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], random: &mut Generator) -> Transition {
        self.push(action[0]);
        let fails = self.x < -MAX_X || self.x > MAX_X || self.angle < -MAX_ANGLE || self.angle > MAX_ANGLE;
        // Only steps after the end fail twice.
        let reward = parameters.rewards[usize::from(fails) + usize::from(fails && self.has_failed)];
        self.has_failed |= fails;
        self.steps = self.steps.saturating_add(1);
        let observed =
            if parameters.velocities { [self.velocity, self.angular_velocity] } else { [self.x, self.angle] };
        self.observe(observed, parameters, random);
        Transition { reward, terminated: fails, truncated: self.steps >= parameters.length }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        out.copy_from_slice(&self.observation);
    }

    fn markov_state(&self, _: &Parameters, out: &mut [f32]) {
        out.copy_from_slice(&[self.x, self.velocity, self.angle, self.angular_velocity].map(|number| number as f32));
    }

    /// Cart and pole where positions are observed, and bars of the two velocities otherwise.
    fn paint(&self, parameters: &Parameters, canvas: &mut Canvas<'_>) {
        canvas.fill(pictures::DARK);
        let [first, second] = self.observation.map(f64::from);
        if parameters.velocities {
            pictures::gauge(canvas, 24, first / 3.0, pictures::BLUE);
            pictures::gauge(canvas, 50, second / 3.0, pictures::GOLD);
            return;
        }
        let x = 42 + (first / MAX_X * 34.0).clamp(-60.0, 60.0).round() as i32;
        canvas.draw_line(pictures::GREY, (0, 66), (83, 66), 1);
        canvas.draw_rect(pictures::BLUE, Rect::new(x - 8, 56, 17, 10), 0);
        let end = (x + (40.0 * second.sin()).round() as i32, 56 - (40.0 * second.cos()).round() as i32);
        canvas.draw_line(pictures::GOLD, (x, 56), end, 4);
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        let Parameters { low, high, .. } = *parameters;
        let numbers = [self.x, self.velocity, self.angle, self.angular_velocity];
        let is_first = self.steps == 0;
        let is_possible = |(number, (bound, bound_after_end)): (f64, (f64, f64))| match self.has_failed {
            true => !is_first && number.abs() <= bound_after_end,
            false if is_first => low <= number && number <= low + (high - low),
            false => number.abs() <= bound,
        };
        let positions =
            if parameters.velocities && !is_first { [numbers[1], numbers[3]] } else { [numbers[0], numbers[2]] };
        numbers.into_iter().zip(BOUNDS.into_iter().zip(BOUNDS_AFTER_END)).all(is_possible)
            && match parameters.noise {
                Some(_) => self.observation.iter().zip(HIGH).all(|(number, high)| number.abs() <= high),
                None => self.observation == positions.map(|number| number as f32),
            }
    }

    fn expert(parameters: &Parameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(Balance {
            sees_velocities: parameters.velocities,
            variance: variance(parameters.noise),
            estimate: CartPole::default(),
            filters: [Filter::new(0.0, 0.0); 2],
            last: None,
        }))
    }
}

/// Pushes to the side to which the pole will fall, by what it knows of the motion and observes.
struct Balance {
    sees_velocities: bool,
    /// Variance of observed positions.
    variance: f64,
    estimate: CartPole,
    /// Of the cart, and of the pole.
    filters: [Filter; 2],
    /// The last action.
    last: Option<i32>,
}

impl Expert for Balance {
    fn reset(&mut self) {
        // Positions and velocities are at first uniform in ±0.05.
        let variance = 0.05 * 0.05 / 3.0;
        (self.filters, self.last) = ([Filter::new(variance, variance); 2], None);
        self.estimate = CartPole::default();
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        let seen = [features[0], features[1]].map(f64::from);
        if let Some(last) = self.last {
            self.estimate.push(last);
            let [cart, pole] = &mut self.filters;
            cart.predict(0.0, SECONDS, 1.0);
            pole.predict(GRAVITY / (LENGTH * (4.0 / 3.0 - MASS_POLE / TOTAL_MASS)), SECONDS, 1.0);
        }
        let CartPole { x, velocity, angle, angular_velocity, .. } = &mut self.estimate;
        // The first observation shows positions in any case.
        if self.sees_velocities && self.last.is_some() {
            [*velocity, *angular_velocity] = seen;
        } else {
            let estimates = [(&mut *x, &mut *velocity), (&mut *angle, &mut *angular_velocity)];
            for ((filter, seen), (position, velocity)) in self.filters.iter_mut().zip(seen).zip(estimates) {
                let (error, gains) = (seen - *position, filter.correct(self.variance));
                *position += gains[0] * error;
                *velocity += gains[1] * error;
            }
        }
        let side = *angle + 0.3 * *angular_velocity + 0.02 * *x + 0.05 * *velocity;
        action[0] = i32::from(side > 0.0);
        self.last = Some(action[0]);
    }
}
