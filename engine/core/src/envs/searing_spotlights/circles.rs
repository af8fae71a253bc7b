//! Circles side by side, so that vector instructions test all of them at once: most tests of a frame are about circles that are far
//! away, and no branch predictor knows which are near.

use smallvec::SmallVec;

use super::circle::{Circle, Edges};
use super::crescents::{MAX_MOVED_RADIUS, REACH};

/// Circles of a block.
const LANES: usize = 8;

/// Up to [`LANES`] circles. The lanes behind the last circle are 0.
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

    /// A bit for each circle that may light a pixel from `left` and `top` to `right` and `bottom`.
    #[inline(always)]
    fn reaching(&self, Edges { left, top, right, bottom }: Edges) -> u16 {
        // The distance outside of the rectangle along one axis, at most 255, so that squares fit into 16 bits. That and the saturated
        // sum of squares change nothing for radii below 256. With 256, the largest, a circle just out of reach may be reported.
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

    /// A bit for each circle that is not where `former` has it, and whether all have made no move but a precomputed one.
    #[inline(always)]
    fn moved_since(&self, former: &Block) -> (u16, bool) {
        let is_near = |distance: i16| (distance.wrapping_add(REACH)) as u16 <= 2 * REACH as u16;
        let (mut bits, mut all_near) = ([0; LANES], true);
        for (lane, bit) in bits.iter_mut().enumerate() {
            let x = self.x[lane].wrapping_sub(former.x[lane]);
            let y = self.y[lane].wrapping_sub(former.y[lane]);
            let moved = x | y != 0;
            let near = is_near(x) & is_near(y) & (self.radius[lane] <= MAX_MOVED_RADIUS);
            *bit = if moved { 1 << lane } else { 0 };
            all_near &= (self.radius[lane] == former.radius[lane]) & (!moved | near);
        }
        (bits.iter().fold(0, |all, bit| all | bit), all_near)
    }
}

/// Any number of circles side by side, in order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Circles {
    len: usize,
    blocks: SmallVec<[Block; 1]>,
}

impl Circles {
    /// The most circles of which [`Numbers`] can be made.
    pub const MAX_NUMBERED: usize = u32::BITS as usize;

    #[inline(always)]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Adds a circle behind the last.
    #[inline]
    pub fn push(&mut self, circle: &Circle) {
        let (block, lane) = (self.len / LANES, self.len % LANES);
        if lane == 0 {
            self.blocks.push(Block::default());
        }
        self.blocks[block].set(lane, circle);
        self.len += 1;
    }

    /// A circle.
    ///
    /// # Panics
    ///
    /// If there is none of that number.
    #[inline(always)]
    pub fn get(&self, number: usize) -> Circle {
        let (block, lane) = (&self.blocks[number / LANES], number % LANES);
        Circle { x: block.x[lane], y: block.y[lane], radius: block.radius[lane] }
    }

    pub fn iter(&self) -> impl Iterator<Item = Circle> {
        (0..self.len).map(|number| self.get(number))
    }

    /// The circles that may light a pixel of a rectangle: those that [reach](Circle::reaches) it, and some of the largest radius
    /// that do not. Only for at most [`MAX_NUMBERED`](Self::MAX_NUMBERED) circles.
    #[inline(always)]
    pub fn reaching(&self, rect: impl Into<Edges>) -> Numbers {
        let edges = rect.into();
        let bits = |(number, block): (usize, &Block)| u32::from(block.reaching(edges)) << (number * LANES);
        Numbers(self.blocks.iter().enumerate().map(bits).fold(0, |all, bits| all | bits))
    }

    /// The circles that are not where `former` has them. `None` unless all have made no move but a precomputed one. Only for at most
    /// [`MAX_NUMBERED`](Self::MAX_NUMBERED) circles.
    #[inline(always)]
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

/// The numbers of some of at most [`MAX_NUMBERED`](Circles::MAX_NUMBERED) circles, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Numbers(u32);

impl Numbers {
    pub const NONE: Numbers = Numbers(0);

    #[inline(always)]
    pub fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Those that are in both.
    #[inline(always)]
    pub fn and(self, other: Numbers) -> Numbers {
        Numbers(self.0 & other.0)
    }

    /// Adds a number if `present`.
    #[inline(always)]
    pub fn set(&mut self, number: usize, present: bool) {
        self.0 |= u32::from(present) << number;
    }

    /// All but one.
    #[inline(always)]
    pub fn without(self, number: usize) -> Numbers {
        Numbers(self.0 & !(1 << number))
    }
}

impl Iterator for Numbers {
    type Item = usize;

    #[inline(always)]
    fn next(&mut self) -> Option<usize> {
        let number = self.0.trailing_zeros() as usize;
        // Without the lowest bit.
        (self.0 != 0).then(|| self.0 &= self.0 - 1).map(|()| number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::envs::searing_spotlights::shape::Shape;
    use crate::raster::Rect;

    fn circles(circles: impl IntoIterator<Item = (i16, i16, i16)>) -> Circles {
        let mut lanes = Circles::default();
        circles.into_iter().for_each(|(x, y, radius)| lanes.push(&Circle { x, y, radius }));
        lanes
    }

    #[test]
    fn circles_side_by_side_reach_what_each_reaches() {
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
    fn moves_are_found_where_all_are_precomputed() {
        let former = circles((0..20).map(|i| (i * 4, 50, 10)));
        let moved_by = |number: i16, by: (i16, i16), radius: i16| {
            circles((0..20).map(|i| if i == number { (i * 4 + by.0, 50 + by.1, radius) } else { (i * 4, 50, 10) }))
        };
        assert_eq!(former.moved_since(&former), Some(Numbers::NONE));
        for x in -5..=5 {
            for y in -5..=5 {
                let moved = moved_by(17, (x, y), 10).moved_since(&former).map(Iterator::collect::<Vec<_>>);
                let expected = if (x, y) == (0, 0) { vec![] } else { vec![17] };
                assert_eq!(moved, Shape::is_precomputed(10, (x, y)).then_some(expected), "{x}, {y}");
            }
        }
        assert_eq!(moved_by(3, (0, 0), 11).moved_since(&former), None, "another radius");
        assert_eq!(circles((0..19).map(|i| (i * 4, 50, 10))).moved_since(&former), None, "one less");
        let large = |x| circles([(x, 40, MAX_MOVED_RADIUS + 1)]);
        assert_eq!(large(40).moved_since(&large(40)), Some(Numbers::NONE));
        assert_eq!(large(41).moved_since(&large(40)), None, "no crescents of that radius");
    }
}
