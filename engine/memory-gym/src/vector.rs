//! Vector operations with the same rounding as pygame's `Vector2`.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Maximum difference in radians from a quarter turn for an angle to count as one.
const EPSILON: f64 = 1e-6;

/// `vector.rotate(degrees)`: exact for quarter turns, with sine and cosine for all other angles.
pub fn rotate([x, y]: [f64; 2], degrees: f64) -> [f64; 2] {
    let angle = (degrees * PI / 180.0).rem_euclid(TAU);
    if (angle + EPSILON) % FRAC_PI_2 < 2.0 * EPSILON {
        return match ((angle + EPSILON) / FRAC_PI_2) as i32 {
            1 => [-y, x],
            2 => [-x, -y],
            3 => [y, -x],
            _ => [x, y],
        };
    }
    let (sin, cos) = angle.sin_cos();
    [cos * x - sin * y, sin * x + cos * y]
}

/// `from.lerp(to, share)`: the point at that share (0 to 1) of the line from `from` to `to`.
pub fn lerp(from: [f64; 2], to: [f64; 2], share: f64) -> [f64; 2] {
    std::array::from_fn(|axis| from[axis] * (1.0 - share) + to[axis] * share)
}

/// `a.distance_to(b)`.
pub fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    let [x, y] = [b[0] - a[0], b[1] - a[1]];
    (x * x + y * y).sqrt()
}
