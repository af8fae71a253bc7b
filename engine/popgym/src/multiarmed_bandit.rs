//! Multiarmed Bandit: find the arms that pay best.

use endless_gym_core::envs::{
    ActionSpace, Column, EnvSpec, Expert, ObservationSpace, Parameter, ParameterError, ResetParameters, StatePart,
    Task, Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;
use serde::{Deserialize, Serialize};

use crate::ids::{levels, numbered, shape};
use crate::pictures;

const ARGUMENTS: &[Parameter] = &[
    Parameter::int("num_bandits", 10, 1, 1000, "number of arms"),
    Parameter::int("episode_length", 200, 1, i32::MAX as i64, "steps of an episode"),
];

/// Arms, the length of an episode, and the reward.
pub struct Parameters {
    arms: usize,
    length: u32,
    reward: f64,
}

/// The state of an episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MultiarmedBandit {
    /// How likely each arm pays.
    arms: Vec<f32>,
    steps: u32,
    has_paid: bool,
}

impl Task for MultiarmedBandit {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const FEATURES: &[Column] = &[Column { name: "paid", description: "1 if the last arm paid, otherwise 0" }];
        EnvSpec {
            features: FEATURES,
            needs_previous_action: true,
            observation_space: Some(ObservationSpace::Discrete(2)),
            arguments: ARGUMENTS,
            ..EnvSpec::new("MultiarmedBandit", "Find the arms that pay best", ActionSpace::Discrete(1))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        let harder = ["num_bandits=20&episode_length=400", "num_bandits=30&episode_length=600"];
        levels::<Self>(Self::spec(), ["", harder[0], harder[1]])
    }

    fn with_arguments(spec: EnvSpec, &Parameters { arms, .. }: &Parameters) -> Result<EnvSpec, ParameterError> {
        let state = StatePart::shares("bandits", shape(&[arms]), "probability that each arm pays");
        Ok(EnvSpec {
            action_space: ActionSpace::Discrete(arms as i32),
            markov_state: vec![state].leak(),
            ground_truth: numbered("bandits", arms, "probability that the arm pays"),
            ..spec
        })
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let (arms, length) = (given.int("num_bandits", 1) as usize, given.int("episode_length", 1) as u32);
        Parameters { arms, length, reward: 1.0 / f64::from(length) }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        self.arms.clear();
        self.arms.resize_with(parameters.arms, || random.random_f32());
        (self.steps, self.has_paid) = (0, false);
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], random: &mut Generator) -> Transition {
        // numpy compares a Python float with a float32 in float32.
        self.has_paid = (random.random() as f32) < self.arms[action[0] as usize];
        self.steps = self.steps.saturating_add(1);
        let reward = if self.has_paid { parameters.reward } else { -parameters.reward };
        Transition { reward, terminated: false, truncated: self.steps >= parameters.length }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        out[0] = f32::from(u8::from(self.has_paid));
    }

    /// A coin if the last arm paid.
    fn paint(&self, _: &Parameters, canvas: &mut Canvas<'_>) {
        canvas.fill(pictures::DARK);
        canvas.draw_circle(pictures::GREY, (42, 42), 30, 2);
        if self.has_paid {
            canvas.draw_circle(pictures::GOLD, (42, 42), 28, 0);
            canvas.draw_circle(pictures::PAPER, (42, 42), 20, 2);
        }
    }

    fn ground_truth(&self, _: &Parameters, out: &mut [f64]) {
        for (out, arm) in out.iter_mut().zip(&self.arms) {
            *out = f64::from(*arm);
        }
    }

    fn markov_state(&self, _: &Parameters, out: &mut [f32]) {
        out.copy_from_slice(&self.arms);
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        // Multiples of 2⁻²⁴, as the generator draws them.
        self.arms.iter().all(|arm| (0.0..1.0).contains(arm) && (arm * 2_f32.powi(24)).fract() == 0.0)
            && self.arms.len() == parameters.arms
            && (self.steps > 0 || !self.has_paid)
    }

    fn expert(parameters: &Parameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(Optimist { pulls: vec![[0.0; 2]; parameters.arms], last: None }))
    }
}

/// Pulls the arm with the highest plausible probability: the posterior mean plus 1.5 standard deviations.
struct Optimist {
    /// How often each arm did not pay and paid.
    pulls: Vec<[f64; 2]>,
    last: Option<usize>,
}

impl Expert for Optimist {
    fn reset(&mut self) {
        self.pulls.fill([0.0; 2]);
        self.last = None;
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        if let Some(last) = self.last {
            self.pulls[last][usize::from(features[0] == 1.0)] += 1.0;
        }
        // The prior is uniform, so the posterior is a beta distribution.
        let bound = |[unpaid, paid]: [f64; 2]| {
            let pulls = unpaid + paid + 2.0;
            let mean = (paid + 1.0) / pulls;
            mean + 1.5 * (mean * (1.0 - mean) / (pulls + 1.0)).sqrt()
        };
        let arms = self.pulls.iter().map(|pulls| bound(*pulls)).enumerate();
        let arm = arms.max_by(|(_, a), (_, b)| a.total_cmp(b)).map_or(0, |(arm, _)| arm);
        self.last = Some(arm);
        action[0] = arm as i32;
    }
}
