//! The spotlights: how they appear and move.
//!
//! Source: `Spotlight` of the original's `pygame_assets.py`.

use serde::{Deserialize, Serialize};

use super::circles::Circle;
use super::parameters::{MAX_SPOT_RADIUS, Parameters};
use crate::screen::SCREEN;
use crate::vector::{distance, lerp, rotate};
use endless_gym_core::random::Generator;

/// A spotlight that moves across the screen along a parabola, from one position off the screen to another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Spotlight {
    /// In pixels.
    pub radius: i32,
    /// Centre in pixels, as of the last step in which it moved.
    pub location: [f64; 2],
    /// Share of the path per step.
    speed: f64,
    /// Share of the path covered so far, 0 to 1.
    progress: f64,
    /// Whether it has reached the end of its path.
    pub done: bool,
    start: [f64; 2],
    /// It starts towards `target` but ends at `bend`.
    target: [f64; 2],
    bend: [f64; 2],
}

impl Spotlight {
    /// A random spotlight just off the screen.
    pub fn spawn(parameters: &Parameters, random: &mut Generator) -> Self {
        // numpy truncates both ends.
        let (low, high) = (parameters.spot_min_radius, parameters.spot_max_radius + 1.0);
        let radius = random.integers(low as i64, high as i64) as i32;
        let speed = random.uniform(parameters.spot_min_speed, parameters.spot_max_speed);
        let start = random.integers(0, 360);
        let target = start + 180 + random.integers(-45, 45);
        let bend = target + random.integers(-135, 135);

        let at = |degrees: i64| {
            rotate([Self::distance(radius), 0.0], degrees as f64).map(|coordinate| Self::CENTRE + coordinate)
        };
        let start = at(start);
        Spotlight {
            radius,
            location: start,
            speed,
            progress: 0.0,
            done: false,
            start,
            target: at(target),
            bend: at(bend),
        }
    }

    /// Whether there can be such a spotlight. A forged snapshot may hold any numbers.
    pub fn is_valid(&self, parameters: &Parameters) -> bool {
        let speeds = [parameters.spot_min_speed, parameters.spot_max_speed];
        let outside = Self::distance(self.radius);
        let offset = |position: [f64; 2]| distance(position, [Self::CENTRE; 2]);
        (0..=MAX_SPOT_RADIUS).contains(&self.radius)
            && [self.start, self.target, self.bend].into_iter().all(|end| (offset(end) - outside).abs() < 1e-6)
            && offset(self.location) < outside + 1e-6
            && (0.0..=1.0).contains(&self.progress)
            && self.done == (self.progress == 1.0)
            && (speeds[0].min(speeds[1]) - 1e-9..=speeds[0].max(speeds[1]) + 1e-9).contains(&self.speed)
    }

    const CENTRE: f64 = (SCREEN / 2) as f64;

    /// Distance of both ends from the centre of the screen: half its diagonal, and the radius.
    fn distance(radius: i32) -> f64 {
        let size = SCREEN as f64;
        (size * size + size * size).sqrt() / 2.0 + f64::from(radius)
    }

    /// Moves to the position of this step.
    pub fn advance(&mut self) {
        let towards = lerp(self.target, self.bend, self.progress);
        self.location = lerp(self.start, towards, self.progress);
        self.progress += self.speed;
        if self.progress >= 1.0 {
            self.progress = 1.0;
            self.done = true;
        }
    }

    /// The circle that it lights.
    pub fn circle(&self) -> Circle {
        let [x, y] = self.location;
        Circle { x: x as i16, y: y as i16, radius: self.radius as i16 }
    }
}
