//! Where a spotlight will be, from where it was seen.

use super::plan::Place;
use crate::envs::screen::SCREEN;

/// How far a seen centre is off, in pixels: it is cut to whole pixels.
const NOISE: f64 = 0.3;

/// What is known of any spotlight before it has moved: it comes in towards the middle by about so many pixels per step,
/// and its acceleration is about this small.
const SPEED: f64 = 0.6;
const SPEED_DEVIATION: f64 = 0.4;
const ACCELERATION: f64 = 0.006;

/// Frames that a spotlight may be missing from before it is given up: it may stand still in the dark for one.
const PATIENCE: u32 = 3;

/// A spotlight's motion, which is a parabola in time, estimated from the places that it was seen at.
///
/// Time counts from the last sighting, backwards for those before.
#[derive(Clone, Debug)]
pub(super) struct Forecast {
    pub radius: i32,
    /// Unit vector from where it was first seen towards the middle of the screen.
    heading: [f64; 2],
    seen: Vec<[f64; 2]>,
    missed: u32,
    /// Per axis: place, speed, acceleration.
    motion: [[f64; 3]; 2],
    /// How uncertain the motion is, the same for both axes.
    covariance: [[f64; 3]; 3],
}

impl Forecast {
    /// A spotlight that is seen for the first time.
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

    /// Takes in where it is now.
    pub fn observe(&mut self, place: Place) {
        self.missed = 0;
        // The middle of the places that are cut to this pixel.
        self.seen.push(place.map(|coordinate| f64::from(coordinate) + 0.5 * f64::from(coordinate.signum())));
        self.fit();
    }

    /// It is not seen in this frame.
    pub fn miss(&mut self) {
        self.missed += 1;
    }

    /// Whether it may still be there.
    pub fn is_fresh(&self) -> bool {
        self.missed <= PATIENCE
    }

    /// Pixels between where it was expected in this frame and a place.
    pub fn surprise(&self, place: Place) -> f64 {
        let ([x, y], _) = self.at(1);
        (x - f64::from(place[0])).hypot(y - f64::from(place[1]))
    }

    /// Its centre `steps` after the current frame, and by about how many pixels that may be wrong.
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

    /// Least squares, with what is known beforehand as further sightings.
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
    fn a_parabola_is_foreseen() {
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
