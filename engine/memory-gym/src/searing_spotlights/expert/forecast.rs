//! Forecasts a spotlight's positions from its observed positions.

use super::plan::Place;
use crate::screen::SCREEN;

/// Standard deviation of an observed centre in pixels, due to its truncation to whole pixels.
const NOISE: f64 = 0.3;

/// Prior mean of the speed towards the middle of the screen, in pixels per step.
const SPEED: f64 = 0.6;
/// Prior standard deviation of the speed.
const SPEED_DEVIATION: f64 = 0.4;
/// Prior standard deviation of the acceleration, whose prior mean is 0.
const ACCELERATION: f64 = 0.006;

/// Number of consecutive frames in which a spotlight may be missing. A spotlight may skip a step.
const PATIENCE: u32 = 3;

/// A spotlight's motion, a parabola in time, estimated from its observed positions.
///
/// Time is relative to the last observation, negative for earlier ones.
#[derive(Clone, Debug)]
pub(super) struct Forecast {
    pub radius: i32,
    /// Unit vector from the first observed position to the middle of the screen.
    heading: [f64; 2],
    seen: Vec<[f64; 2]>,
    missed: u32,
    /// Position, speed and acceleration for each axis.
    motion: [[f64; 3]; 2],
    /// Covariance of the motion, the same for both axes.
    covariance: [[f64; 3]; 3],
}

impl Forecast {
    /// The forecast after the first observation.
    pub fn new(radius: i32, place: Place) -> Self {
        let [x, y] = place.map(|coordinate| SCREEN as f64 / 2.0 - f64::from(coordinate));
        let distance = x.hypot(y).max(1.0);
        let mut forecast = Forecast {
            radius,
            heading: [x / distance, y / distance],
            seen: Vec::new(),
            missed: 0,
            motion: [[0.0; 3]; 2],
            covariance: [[0.0; 3]; 3],
        };
        forecast.observe(place);
        forecast
    }

    /// Adds the position in the current frame.
    pub fn observe(&mut self, place: Place) {
        self.missed = 0;
        // The middle of the interval that is truncated to this pixel.
        self.seen.push(place.map(|coordinate| f64::from(coordinate) + 0.5 * f64::from(coordinate.signum())));
        self.fit();
    }

    /// Records that the spotlight is missing from the current frame.
    pub fn miss(&mut self) {
        self.missed += 1;
    }

    /// Whether the spotlight may still be on the screen.
    pub fn is_alive(&self) -> bool {
        self.missed <= PATIENCE
    }

    /// Distance in pixels between the forecast for this frame and a position.
    pub fn error(&self, place: Place) -> f64 {
        let ([x, y], _) = self.at(1);
        (x - f64::from(place[0])).hypot(y - f64::from(place[1]))
    }

    /// The centre `steps` after the current frame, and its standard deviation in pixels.
    pub fn at(&self, steps: usize) -> ([f64; 2], f64) {
        let time = steps as f64 + f64::from(self.missed);
        let terms = [1.0, time, time * time / 2.0];
        let variance: f64 = (0..3)
            .flat_map(|i| (0..3).map(move |j| (i, j)))
            .map(|(i, j)| terms[i] * self.covariance[i][j] * terms[j])
            .sum();
        let centre = self.motion.map(|motion| motion.iter().zip(terms).map(|(factor, term)| factor * term).sum());
        (centre, variance.max(0.0).sqrt())
    }

    /// Fits the motion by least squares, with the prior as additional observations.
    fn fit(&mut self) {
        let mut normal = [[0.0; 3]; 3];
        normal[1][1] = (SPEED_DEVIATION * SPEED_DEVIATION).recip();
        normal[2][2] = (ACCELERATION * ACCELERATION).recip();
        let mut right = self.heading.map(|heading| [0.0, heading * SPEED * normal[1][1], 0.0]);
        let weight = (NOISE * NOISE).recip();
        for (age, place) in self.seen.iter().rev().enumerate() {
            let time = -(age as f64);
            let terms = [1.0, time, time * time / 2.0];
            for i in 0..3 {
                for j in 0..3 {
                    normal[i][j] += weight * terms[i] * terms[j];
                }
                for axis in 0..2 {
                    right[axis][i] += weight * terms[i] * place[axis];
                }
            }
        }
        self.covariance = inverse(&normal);
        self.motion = right
            .map(|right| self.covariance.map(|row| row.iter().zip(right).map(|(factor, value)| factor * value).sum()));
    }
}

/// The inverse of a symmetric positive definite matrix.
fn inverse(m: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let cofactor = |i: usize, j: usize| {
        let (a, b, c, d) = ((i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3);
        m[a][c] * m[b][d] - m[a][d] * m[b][c]
    };
    let determinant: f64 = (0..3).map(|j| m[0][j] * cofactor(0, j)).sum();
    std::array::from_fn(|i| std::array::from_fn(|j| cofactor(j, i) / determinant))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parabola_is_forecast() {
        let at = |time: f64| [10.0 + 0.7 * time - 0.002 * time * time, 60.0 - 0.4 * time + 0.003 * time * time];
        let mut forecast = Forecast::new(9, at(0.0).map(|coordinate| coordinate as i32));
        let (_, at_first) = forecast.at(20);
        for time in 1..40 {
            forecast.observe(at(f64::from(time)).map(|coordinate| coordinate as i32));
        }
        let ([x, y], deviation) = forecast.at(20);
        let expected = at(59.0);
        assert!((x - expected[0]).hypot(y - expected[1]) < 1.5, "{x}, {y} instead of {expected:?}");
        assert!(deviation < 1.5 && at_first > 5.0, "{deviation}, {at_first}");
    }
}
