//! The circles that spotlights light.

use serde::{Deserialize, Serialize};

use super::config::BAR_HEIGHT;
use crate::envs::screen::SCREEN;
use crate::raster::Rect;

/// A lit circle, in pixels of the screen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Circle {
    /// Horizontal centre.
    pub x: i16,
    /// Vertical centre.
    pub y: i16,
    /// Radius, 0 to [`MAX_SPOT_RADIUS`](super::parameters::MAX_SPOT_RADIUS).
    pub radius: i16,
}

/// The edges of a rectangle, in pixels of the screen, limited to what circles are compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Edges {
    pub left: i16,
    pub top: i16,
    pub right: i16,
    pub bottom: i16,
}

impl From<&Rect> for Edges {
    #[inline(always)]
    fn from(rect: &Rect) -> Self {
        let limited = |edge: i32| edge.clamp(i16::MIN.into(), i16::MAX.into()) as i16;
        Edges {
            left: limited(rect.x),
            top: limited(rect.y),
            right: limited(rect.x + rect.width),
            bottom: limited(rect.y + rect.height),
        }
    }
}

impl Circle {
    /// Its centre in pixels.
    pub fn centre(&self) -> (i32, i32) {
        (self.x.into(), self.y.into())
    }

    /// The smallest rectangle around it.
    #[inline(always)]
    pub fn bounds(&self) -> Rect {
        let ((x, y), radius) = (self.centre(), i32::from(self.radius));
        Rect::new(x - radius, y - radius, 2 * radius, 2 * radius)
    }

    /// Whether a part of it may be visible: on the screen, and not only behind the bar at the top.
    #[inline(always)]
    pub fn is_on_screen(&self) -> bool {
        let (low, high) = (-self.radius, SCREEN as i16 + self.radius);
        let is_within = |at: i16, low: i16| low < at && at < high;
        is_within(self.x, low) && is_within(self.y, BAR_HEIGHT as i16 + low) && self.radius > 0
    }

    /// Whether it may light a pixel of a rectangle: the rectangle's nearest point is within its radius. Without a branch, since none
    /// could be predicted.
    #[inline(always)]
    pub fn reaches(&self, rect: &Rect) -> bool {
        let radius = i32::from(self.radius);
        // The distance outside of the rectangle along one axis; one of `radius` is too far already.
        let gap = |at: i16, low: i32, length: i32| {
            let at = i32::from(at);
            (low - at).max(at - low - length).min(radius).max(0)
        };
        let (x, y) = (gap(self.x, rect.x, rect.width), gap(self.y, rect.y, rect.height));
        x * x + y * y < radius * radius
    }

    /// Whether a position is within its radius.
    pub fn contains(&self, (x, y): (i32, i32)) -> bool {
        let (x, y, radius) = (x - i32::from(self.x), y - i32::from(self.y), i32::from(self.radius));
        x * x + y * y < radius * radius
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::envs::searing_spotlights::parameters::MAX_SPOT_RADIUS;
    use crate::envs::searing_spotlights::shape::Shape;

    #[test]
    fn circles_are_visible_up_to_the_last_pixel() {
        let circle = |x, y| Circle { x, y, radius: 10 };
        for (x, y) in [(-9, 40), (93, 40), (40, 93), (40, -5), (42, 42)] {
            assert!(circle(x, y).is_on_screen(), "{x}, {y}");
        }
        for (x, y) in [(-10, 40), (94, 40), (40, 94), (40, -6)] {
            assert!(!circle(x, y).is_on_screen(), "{x}, {y}");
        }
        assert!(!Circle { x: 40, y: 40, radius: 0 }.is_on_screen());
        assert!(circle(40, 40).contains((49, 40)));
        assert!(!circle(40, 40).contains((50, 40)));
    }

    #[test]
    fn circles_reach_what_they_light() {
        for radius in 0..=MAX_SPOT_RADIUS {
            let (circle, disc) = (Circle { x: 0, y: 0, radius: radius as i16 }, &Shape::of(radius as i16).extent.disc);
            for (x, y) in (-radius..radius).flat_map(|x| (-radius..radius).map(move |y| (x, y))) {
                let pixel = Rect::new(x, y, 1, 1);
                assert!(circle.reaches(&pixel) || !disc.contains((x, y)), "radius {radius}: {x}, {y}");
            }
        }
    }
}
