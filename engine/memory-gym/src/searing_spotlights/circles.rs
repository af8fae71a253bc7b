//! The circles that spotlights light.
//!
//! A frame's circles are stored as a structure of arrays, so that vector instructions test all of them at once: most tests are
//! about circles that are far away, and no branch predictor knows which are near.

use serde::{Deserialize, Serialize};
use smallvec::SmallVec;

use super::config::BAR_HEIGHT;
use super::parameters::MAX_SPOT_RADIUS;
use crate::screen::SCREEN;
use endless_gym_core::raster::Rect;

/// Longest move along each axis, in pixels, for which a circle's crescents are precomputed.
pub(super) const REACH: i16 = 3;

/// Maximum radius for which crescents are precomputed. Larger circles are repainted in full.
pub(super) const MAX_MOVED_RADIUS: i16 = 24;

/// Whether the crescents of a move are precomputed. Branchless, for vector instructions.
#[inline]
pub(super) fn is_short_move(radius: i16, (x, y): (i16, i16)) -> bool {
    let is_near = |distance: i16| (distance.wrapping_add(REACH)) as u16 <= 2 * REACH as u16;
    is_near(x) & is_near(y) & (radius <= MAX_MOVED_RADIUS)
}

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

/// The edges of a rectangle in pixels of the screen, limited to `i16`, the type of a circle's numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Edges {
    pub left: i16,
    pub top: i16,
    pub right: i16,
    pub bottom: i16,
}

impl From<&Rect> for Edges {
    #[inline]
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
    /// Whether a spotlight can light it. A forged snapshot may hold any numbers.
    pub fn is_valid(&self) -> bool {
        let far = SCREEN as i16 + MAX_SPOT_RADIUS as i16 + 20;
        [self.x, self.y].iter().all(|at| at.unsigned_abs() < far as u16)
            && (0..=MAX_SPOT_RADIUS as i16).contains(&self.radius)
    }

    /// Its centre in pixels.
    pub fn centre(&self) -> (i32, i32) {
        (self.x.into(), self.y.into())
    }

    /// The smallest rectangle around it.
    #[inline]
    pub fn bounds(&self) -> Rect {
        let ((x, y), radius) = (self.centre(), i32::from(self.radius));
        Rect::new(x - radius, y - radius, 2 * radius, 2 * radius)
    }

    /// Whether any part of it may be visible: on the screen, and not only behind the bar at the top.
    #[inline]
    pub fn is_on_screen(&self) -> bool {
        let (low, high) = (-self.radius, SCREEN as i16 + self.radius);
        let is_within = |at: i16, low: i16| low < at && at < high;
        is_within(self.x, low) && is_within(self.y, BAR_HEIGHT as i16 + low) && self.radius > 0
    }

    /// Whether it may light a pixel of a rectangle: the rectangle's nearest point is within its radius. Branchless, since the
    /// branches would be unpredictable.
    #[inline]
    pub fn reaches(&self, rect: &Rect) -> bool {
        let radius = i32::from(self.radius);
        // The distance from the rectangle along one axis, limited to `radius`, which is already too far.
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

/// Circles in a block.
const LANES: usize = 8;

/// Up to [`LANES`] circles. The lanes after the last circle are 0.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Block {
    x: [i16; LANES],
    y: [i16; LANES],
    radius: [i16; LANES],
    /// Squares of the radii, at most [`u16::MAX`].
    square: [u16; LANES],
}

impl Block {
    #[inline]
    fn set(&mut self, lane: usize, circle: &Circle) {
        let radius = i32::from(circle.radius);
        (self.x[lane], self.y[lane], self.radius[lane]) = (circle.x, circle.y, circle.radius);
        self.square[lane] = (radius * radius).min(u16::MAX.into()) as u16;
    }

    /// A bit for each circle that may light a pixel of the rectangle.
    #[inline]
    fn reaching(&self, Edges { left, top, right, bottom }: Edges) -> u16 {
        // The distance from the rectangle along one axis, limited to 255 so that squares fit into 16 bits. This limit and the
        // saturating sum of squares change nothing for radii below 256. With the maximum of 256, a circle just out of reach may
        // be reported.
        let gap =
            |at: i16, low: i16, high: i16| low.saturating_sub(at).max(at.saturating_sub(high)).clamp(0, 255) as u16;
        let mut bits = [0; LANES];
        for (lane, bit) in bits.iter_mut().enumerate() {
            let (x, y) = (gap(self.x[lane], left, right), gap(self.y[lane], top, bottom));
            let near = (x * x).saturating_add(y * y) < self.square[lane];
            *bit = if near { 1 << lane } else { 0 };
        }
        bits.iter().fold(0, |all, bit| all | bit)
    }

    /// A bit for each circle that has moved since `former`, and whether all moves are precomputed.
    #[inline]
    fn moved_since(&self, former: &Block) -> (u16, bool) {
        let (mut bits, mut all_near) = ([0; LANES], true);
        for (lane, bit) in bits.iter_mut().enumerate() {
            let x = self.x[lane].wrapping_sub(former.x[lane]);
            let y = self.y[lane].wrapping_sub(former.y[lane]);
            let moved = x | y != 0;
            *bit = if moved { 1 << lane } else { 0 };
            all_near &=
                (self.radius[lane] == former.radius[lane]) & (!moved | is_short_move(self.radius[lane], (x, y)));
        }
        (bits.iter().fold(0, |all, bit| all | bit), all_near)
    }
}

/// Any number of circles, in order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Circles {
    len: usize,
    blocks: SmallVec<[Block; 1]>,
}

impl Circles {
    /// Maximum number of circles for which [`Numbers`] can be made.
    pub const MAX_NUMBERED: usize = u32::BITS as usize;

    #[inline]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Appends a circle.
    #[inline]
    pub fn push(&mut self, circle: &Circle) {
        let (block, lane) = (self.len / LANES, self.len % LANES);
        if lane == 0 {
            self.blocks.push(Block::default());
        }
        self.blocks[block].set(lane, circle);
        self.len += 1;
    }

    /// The circle of that number.
    ///
    /// # Panics
    ///
    /// If there is no such circle.
    #[inline]
    pub fn get(&self, number: usize) -> Circle {
        let (block, lane) = (&self.blocks[number / LANES], number % LANES);
        Circle { x: block.x[lane], y: block.y[lane], radius: block.radius[lane] }
    }

    pub fn iter(&self) -> impl Iterator<Item = Circle> {
        (0..self.len).map(|number| self.get(number))
    }

    /// The circles that may light a pixel of a rectangle: those that [reach](Circle::reaches) it, and some of the maximum
    /// radius that do not. Only for at most [`MAX_NUMBERED`](Self::MAX_NUMBERED) circles.
    #[inline]
    pub fn reaching(&self, rect: impl Into<Edges>) -> Numbers {
        let edges = rect.into();
        let bits = |(number, block): (usize, &Block)| u32::from(block.reaching(edges)) << (number * LANES);
        Numbers(self.blocks.iter().enumerate().map(bits).fold(0, |all, bits| all | bits))
    }

    /// The circles that have moved since `former`; `None` unless all moves are precomputed. Only for at most
    /// [`MAX_NUMBERED`](Self::MAX_NUMBERED) circles.
    #[inline]
    pub fn moved_since(&self, former: &Circles) -> Option<Numbers> {
        if self.len != former.len {
            return None;
        }
        let (mut all, mut all_near) = (0, true);
        for (number, (block, former)) in self.blocks.iter().zip(&former.blocks).enumerate() {
            let (bits, near) = block.moved_since(former);
            all |= u32::from(bits) << (number * LANES);
            all_near &= near;
        }
        all_near.then_some(Numbers(all))
    }
}

/// A subset of at most [`MAX_NUMBERED`](Circles::MAX_NUMBERED) circles, as their numbers in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Numbers(u32);

impl Numbers {
    pub const NONE: Numbers = Numbers(0);

    #[inline]
    pub fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// The numbers in both sets.
    #[inline]
    pub fn and(self, other: Numbers) -> Numbers {
        Numbers(self.0 & other.0)
    }

    /// Adds a number if `present`.
    #[inline]
    pub fn set(&mut self, number: usize, present: bool) {
        self.0 |= u32::from(present) << number;
    }

    /// All numbers except one.
    #[inline]
    pub fn without(self, number: usize) -> Numbers {
        Numbers(self.0 & !(1 << number))
    }
}

impl Iterator for Numbers {
    type Item = usize;

    #[inline]
    fn next(&mut self) -> Option<usize> {
        let number = self.0.trailing_zeros() as usize;
        // Clears the lowest bit.
        (self.0 != 0).then(|| self.0 &= self.0 - 1).map(|()| number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::searing_spotlights::parameters::MAX_SPOT_RADIUS;
    use endless_gym_core::raster::Disc;

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
            let (circle, disc) = (Circle { x: 0, y: 0, radius: radius as i16 }, Disc::new(radius));
            for (x, y) in (-radius..radius).flat_map(|x| (-radius..radius).map(move |y| (x, y))) {
                let pixel = Rect::new(x, y, 1, 1);
                assert!(circle.reaches(&pixel) || !disc.contains((x, y)), "radius {radius}: {x}, {y}");
            }
        }
    }

    fn circles(circles: impl IntoIterator<Item = (i16, i16, i16)>) -> Circles {
        let mut lanes = Circles::default();
        circles.into_iter().for_each(|(x, y, radius)| lanes.push(&Circle { x, y, radius }));
        lanes
    }

    #[test]
    fn blocks_of_circles_reach_what_each_circle_reaches() {
        // More than fit into one block, of all sizes, some far off the screen.
        let radii = [1, 2, 5, 11, 24, 100, 254, 255];
        let all = circles(
            (0..30)
                .map(|i| (i * 67 % 90 - 20, i * 31 % 130 - 30, radii[i as usize % 8]))
                .chain([(-8000, 8000, 200), (8000, -8000, 200)]),
        );
        assert_eq!(all.len(), Circles::MAX_NUMBERED);
        let edges = [-200, -3, 0, 17, 60, 84, 300];
        for (x, y) in edges.into_iter().flat_map(|x| edges.map(|y| (x, y))) {
            for (width, height) in [(1, 1), (7, 20), (84, 84)] {
                let rect = Rect::new(x, y, width, height);
                let expected: Vec<usize> = (0..all.len()).filter(|number| all.get(*number).reaches(&rect)).collect();
                assert_eq!(all.reaching(&rect).collect::<Vec<_>>(), expected, "{rect:?}");
            }
        }
        assert!(all.reaching(&Rect::new(1 << 28, -(1 << 28), 9, 9)).is_empty());
        assert!(Circles::default().reaching(&Rect::new(0, 0, 84, 84)).is_empty());
    }

    #[test]
    fn circles_of_the_largest_radius_are_never_missed() {
        for at in -300..300 {
            let (circle, rect) = (Circle { x: at, y: 181, radius: 256 }, Rect::new(0, 0, 1, 1));
            let found = circles([(at, 181, 256)]).reaching(&rect);
            assert!(!found.is_empty() || !circle.reaches(&rect), "{at}");
        }
    }

    #[test]
    fn moves_are_found_if_all_are_precomputed() {
        let former = circles((0..20).map(|i| (i * 4, 50, 10)));
        let moved_by = |number: i16, by: (i16, i16), radius: i16| {
            circles((0..20).map(|i| if i == number { (i * 4 + by.0, 50 + by.1, radius) } else { (i * 4, 50, 10) }))
        };
        assert_eq!(former.moved_since(&former), Some(Numbers::NONE));
        for x in -5..=5 {
            for y in -5..=5 {
                let moved = moved_by(17, (x, y), 10).moved_since(&former).map(Iterator::collect::<Vec<_>>);
                let expected = if (x, y) == (0, 0) { vec![] } else { vec![17] };
                assert_eq!(moved, is_short_move(10, (x, y)).then_some(expected), "{x}, {y}");
            }
        }
        assert_eq!(moved_by(3, (0, 0), 11).moved_since(&former), None, "another radius");
        assert_eq!(circles((0..19).map(|i| (i * 4, 50, 10))).moved_since(&former), None, "one less");
        let large = |x| circles([(x, 40, MAX_MOVED_RADIUS + 1)]);
        assert_eq!(large(40).moved_since(&large(40)), Some(Numbers::NONE));
        assert_eq!(large(41).moved_since(&large(40)), None, "no crescents of that radius");
    }
}
