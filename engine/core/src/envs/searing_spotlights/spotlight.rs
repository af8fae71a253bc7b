//! The spotlights: where they come from, how they move.
//!
//! Source: `Spotlight` of the original's `pygame_assets.py`.

use serde::{Deserialize, Serialize};

use super::parameters::{MAX_SPOT_RADIUS, Parameters};
use super::rules::{BAR_HEIGHT, FAR};
use crate::envs::SCREEN;
use crate::envs::vector::{lerp, rotate};
use crate::random::Generator;
use crate::raster::Rect;

/// A spotlight on its way across the screen, along a parabola from one place off the screen to another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Spotlight {
    /// In pixels.
    pub radius: i32,
    /// Centre in pixels, as of the last step that it moved in.
    pub location: [f64; 2],
    /// Share of the way that one step goes.
    speed: f64,
    /// Share of the way behind it.
    progress: f64,
    /// It has arrived.
    pub done: bool,
    start: [f64; 2],
    /// It sets out towards the target, but ends at the bend.
    target: [f64; 2],
    bend: [f64; 2],
}

impl Spotlight {
    /// Draws a spotlight that waits just off the screen.
    pub fn spawn(parameters: &Parameters, random: &mut Generator) -> Self {
        // numpy cuts the fractions of both ends off.
        let (low, high) = (parameters.spot_min_radius, parameters.spot_max_radius + 1.0);
        let radius = random.integers(low as i64, high as i64) as i32;
        let speed = random.uniform(parameters.spot_min_speed, parameters.spot_max_speed);
        let start = random.integers(0, 360);
        let target = start + 180 + random.integers(-45, 45);
        let bend = target + random.integers(-135, 135);

        let size = SCREEN as f64;
        let distance = (size * size + size * size).sqrt() / 2.0 + f64::from(radius);
        let centre = (SCREEN / 2) as f64;
        let at = |degrees: i64| rotate([distance, 0.0], degrees as f64).map(|coordinate| centre + coordinate);
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

    /// Whether every number is in its range.
    pub fn is_valid(&self) -> bool {
        let near = |place: &[f64; 2]| place.iter().all(|coordinate| coordinate.abs() < f64::from(FAR) / 4.0);
        (0..=MAX_SPOT_RADIUS).contains(&self.radius)
            && [self.location, self.start, self.target, self.bend].iter().all(near)
            && (0.0..=1.0).contains(&self.progress)
            && self.speed >= 0.0
    }

    /// Goes on to the place for this step, where it shines and burns, and gets ready for the next.
    pub fn advance(&mut self) {
        let towards = lerp(self.target, self.bend, self.progress);
        self.location = lerp(self.start, towards, self.progress);
        self.progress += self.speed;
        if self.progress >= 1.0 {
            self.progress = 1.0;
            self.done = true;
        }
    }

    /// The circle that it lights up.
    pub fn circle(&self) -> Circle {
        let [x, y] = self.location;
        Circle { x: x as i16, y: y as i16, radius: self.radius as i16 }
    }
}

/// A lit circle, in pixels of the screen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Circle {
    pub x: i16,
    pub y: i16,
    pub radius: i16,
}

impl Circle {
    /// Its centre.
    pub fn centre(&self) -> (i32, i32) {
        (self.x.into(), self.y.into())
    }

    /// The smallest rectangle about it.
    #[inline]
    pub fn bounds(&self) -> Rect {
        let ((x, y), radius) = (self.centre(), i32::from(self.radius));
        Rect::new(x - radius, y - radius, 2 * radius, 2 * radius)
    }

    /// Whether a part of it may be seen: on the screen, and not only behind the bar at the top.
    #[inline]
    pub fn is_on_screen(&self) -> bool {
        let (low, high) = (-self.radius, SCREEN as i16 + self.radius);
        let is_within = |at: i16, low: i16| low < at && at < high;
        is_within(self.x, low) && is_within(self.y, BAR_HEIGHT as i16 + low) && self.radius > 0
    }

    /// Whether none of its rows is above or below the screen or behind the bar.
    #[inline]
    pub fn has_all_rows(&self) -> bool {
        (BAR_HEIGHT as i16 + self.radius..=SCREEN as i16 - self.radius).contains(&self.y)
    }

    /// Whether it may light a pixel of a rectangle: whether the rectangle's nearest point is within its radius.
    #[inline]
    pub fn reaches(&self, rect: &Rect) -> bool {
        self.comes_within(0, rect)
    }

    /// Whether it would reach a rectangle with a radius of so much more.
    #[inline]
    pub fn comes_within(&self, more: i32, rect: &Rect) -> bool {
        let radius = i32::from(self.radius) + more;
        // Below zero where the centre is within.
        let gap = |at: i16, low: i32, length: i32| (low - i32::from(at)).max(i32::from(at) - low - length);
        let x = gap(self.x, rect.x, rect.width);
        if x >= radius {
            return false;
        }
        let y = gap(self.y, rect.y, rect.height);
        y < radius && x.max(0).pow(2) + y.max(0).pow(2) < radius * radius
    }

    /// Whether a place is within its radius.
    pub fn contains(&self, (x, y): (i32, i32)) -> bool {
        let (x, y, radius) = (x - i32::from(self.x), y - i32::from(self.y), i32::from(self.radius));
        x * x + y * y < radius * radius
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::envs::searing_spotlights::shape::Shape;

    #[test]
    fn circles_are_seen_up_to_the_last_pixel() {
        let circle = |x, y| Circle { x, y, radius: 10 };
        for (x, y) in [(-9, 40), (93, 40), (40, 93), (40, -5), (42, 42)] {
            assert!(circle(x, y).is_on_screen(), "{x}, {y}");
        }
        for (x, y) in [(-10, 40), (94, 40), (40, 94), (40, -6)] {
            assert!(!circle(x, y).is_on_screen(), "{x}, {y}");
        }
        assert!(!Circle { x: 40, y: 40, radius: 0 }.is_on_screen());
        assert!(circle(0, 14).has_all_rows() && circle(84, 74).has_all_rows());
        assert!(!circle(40, 13).has_all_rows() && !circle(40, 75).has_all_rows());
        assert!(circle(40, 40).contains((49, 40)));
        assert!(!circle(40, 40).contains((50, 40)));
    }

    #[test]
    fn circles_reach_what_they_light() {
        for radius in 0..=MAX_SPOT_RADIUS {
            let (circle, disc) = (Circle { x: 0, y: 0, radius: radius as i16 }, &Shape::of(radius as i16).disc);
            for (x, y) in (-radius..radius).flat_map(|x| (-radius..radius).map(move |y| (x, y))) {
                let pixel = Rect::new(x, y, 1, 1);
                assert!(circle.reaches(&pixel) || !disc.contains((x, y)), "radius {radius}: {x}, {y}");
            }
        }
    }
}
