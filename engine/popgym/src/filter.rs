//! Motions whose observations are noisy: their arguments, and a Kalman filter for a position or an angle of a known motion.

use endless_gym_core::envs::{Parameter, ResetParameters};

pub const MAX_LENGTH: Parameter = Parameter::int("max_episode_length", 200, 1, i32::MAX as i64, "steps of an episode");
pub const NOISE: Parameter = Parameter::float("noise_sigma", 0.1, 0.0, 1e6, "standard deviation of the noise");

/// The standard deviation of the noise, if there is noise.
pub fn noise(given: &ResetParameters) -> Option<f64> {
    Some(given.float(NOISE.name, -1.0)).filter(|deviation| *deviation >= 0.0)
}

/// The variance of observations.
pub fn variance(noise: Option<f64>) -> f64 {
    noise.map_or(1e-12, |deviation| deviation.powi(2).max(1e-12))
}

/// The covariance of an estimated position and its velocity.
#[derive(Clone, Copy, Debug)]
pub struct Filter {
    position: f64,
    both: f64,
    velocity: f64,
}

impl Filter {
    /// The variances of independent estimates.
    pub fn new(position: f64, velocity: f64) -> Self {
        Filter { position, both: 0.0, velocity }
    }

    /// The estimate has moved on. `slope` is the derivative of the acceleration with respect to the position. `growth`, 1 or more,
    /// multiplies the covariance, for motions of which the slope is an approximation.
    pub fn predict(&mut self, slope: f64, seconds: f64, growth: f64) {
        let Filter { position, both, velocity } = *self;
        let turn = slope * seconds;
        self.position = growth * (position + seconds * (2.0 * both + seconds * velocity));
        self.both = growth * (both + turn * position + seconds * (velocity + turn * both));
        self.velocity = growth * (velocity + turn * (2.0 * both + turn * position));
    }

    /// The position was observed with this variance. Returns the parts of the observed error by which to correct position and velocity.
    pub fn correct(&mut self, variance: f64) -> [f64; 2] {
        let Filter { position, both, .. } = *self;
        let gains = [position, both].map(|covariance| covariance / (position + variance));
        self.position -= gains[0] * position;
        self.both -= gains[0] * both;
        self.velocity -= gains[1] * both;
        gains
    }
}
