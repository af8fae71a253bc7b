//! The pixels whose light changes when a circle moves: the crescent that it leaves and the one that it enters.

use smallvec::SmallVec;

use super::circle::{Circle, Edges};
use super::config::BAR_HEIGHT;
use super::extent::{Extent, distance};
use crate::envs::screen::{Frame, SCREEN};
use crate::raster::{Disc, Rect};

/// Longest move along each axis whose crescents are precomputed, in pixels.
pub(super) const REACH: i16 = 3;

/// Largest radius whose crescents are precomputed. Larger circles are repainted in full.
pub(super) const MAX_MOVED_RADIUS: i16 = 24;

/// Pixels of a block. Most moves change fewer.
const LANES: usize = 64;

/// The largest distance of a changed pixel from the centre before the move, along one axis.
const MAX_DISTANCE: i16 = MAX_MOVED_RADIUS + REACH;

/// Numbers of columns or rows that may separate the pixels of a block.
const CUTS: usize = 2 * MAX_DISTANCE as usize + 2;

/// Up to [`LANES`] pixels side by side, relative to a circle's centre, so that a set of them is the bits of one number.
#[derive(Debug)]
struct Block {
    /// Bytes in a frame from the centre's pixel.
    steps: [i16; LANES],
    x: [i8; LANES],
    y: [i8; LANES],
    /// For each column from -[`MAX_DISTANCE`] on, a bit for each pixel to the left of it.
    left_of: [u64; CUTS],
    /// For each row, a bit for each pixel above it.
    above: [u64; CUTS],
}

/// The pixels that change when a circle moves.
#[derive(Debug)]
pub(super) struct Crescents {
    /// Relative to the centre before the move: the pixels that the circle leaves, and then those that it enters.
    blocks: SmallVec<[Block; 1]>,
    /// Number of pixels that the circle leaves.
    left: usize,
    /// The smallest rectangle around the pixels that the circle leaves, relative to the centre before the move.
    bounds: Edges,
}

impl Crescents {
    /// The changes when a disc of at most [`MAX_MOVED_RADIUS`] moves by `to`, at most [`REACH`] along each axis.
    pub fn new(disc: &Disc, to: (i32, i32)) -> Self {
        let reach = disc.radius() + to.0.abs().max(to.1.abs());
        let square = (-reach..reach).flat_map(|x| (-reach..reach).map(move |y| (x, y)));
        let (mut left, mut entered) = (Vec::new(), Vec::new());
        for (x, y) in square {
            match (disc.contains((x, y)), disc.contains((x - to.0, y - to.1))) {
                (true, false) => left.push((x, y)),
                (false, true) => entered.push((x, y)),
                _ => {}
            }
        }
        let pixel = |(x, y): &(i32, i32)| Rect::new(*x, *y, 1, 1);
        let bounds = left.iter().map(pixel).reduce(|all, pixel| all.union(&pixel)).unwrap_or_default();
        let all: Vec<_> = left.iter().chain(&entered).map(|(x, y)| (*x as i8, *y as i8)).collect();
        Crescents {
            blocks: all.chunks(LANES).map(Block::new).collect(),
            left: left.len(),
            bounds: Edges::from(&bounds),
        }
    }

    /// The smallest rectangle around the pixels that a circle leaves.
    #[inline(always)]
    pub fn bounds_of_left(&self, circle: &Circle) -> Edges {
        let Edges { left, top, right, bottom } = self.bounds;
        let Circle { x, y, .. } = circle;
        Edges { left: x + left, top: y + top, right: x + right, bottom: y + bottom }
    }

    /// Paints the background of the pixels on the screen below the bar whose light changes.
    ///
    /// Left pixels are copied from the frame `dark`, unless any of `others` lights them, and entered ones from `lit`. Each of `others`
    /// must [reach](Circle::reaches) the [pixels that are left](Self::bounds_of_left).
    #[inline(always)]
    pub fn paint<'a>(
        &self,
        from: &Circle,
        others: Option<impl Iterator<Item = (Circle, &'a Extent)> + Clone>,
        [dark, lit]: [&Frame; 2],
        frame: &mut Frame,
    ) {
        for (number, block) in self.blocks.iter().enumerate() {
            let [left, entered] = self.changed(number, block, from, others.clone());
            block.copy(entered, from, lit, frame);
            block.copy(left, from, dark, frame);
        }
    }

    /// The pixels that [`paint`](Self::paint) paints.
    pub fn painted<'a>(
        &self,
        from: &Circle,
        others: Option<impl Iterator<Item = (Circle, &'a Extent)> + Clone>,
    ) -> impl Iterator<Item = (usize, usize)> {
        self.blocks.iter().enumerate().flat_map(move |(number, block)| {
            let [left, entered] = self.changed(number, block, from, others.clone());
            lanes(left | entered).map(|lane| {
                let (x, y) = (from.x + i16::from(block.x[lane]), from.y + i16::from(block.y[lane]));
                (x as usize, y as usize)
            })
        })
    }

    /// A bit for each pixel of a block that becomes dark, and for each that becomes lit.
    #[inline(always)]
    fn changed<'a>(
        &self,
        number: usize,
        block: &Block,
        from: &Circle,
        others: Option<impl Iterator<Item = (Circle, &'a Extent)>>,
    ) -> [u64; 2] {
        let left = self.left.saturating_sub(number * LANES);
        // The circle itself lights what it enters. Most crescents have fewer pixels than half a block.
        let is_lit = match others {
            None => 0,
            Some(others) if left <= LANES / 2 => block.lit_by::<{ LANES / 2 }>(from, others),
            Some(others) => block.lit_by::<LANES>(from, others),
        };
        // What others light was lit before.
        let (visible, left) = (block.visible(from), below(left));
        [visible & left & !is_lit, visible & !left]
    }
}

/// A bit for each of the first lanes.
#[inline(always)]
fn below(count: usize) -> u64 {
    if count < LANES { (1 << count) - 1 } else { u64::MAX }
}

/// A bit for each byte that is [`u8::MAX`] and not 0.
#[inline(always)]
fn bits(bytes: &[u8]) -> u64 {
    let mut bits = 0;
    for (number, eight) in bytes.as_chunks::<8>().0.iter().enumerate() {
        // Each byte keeps one bit, and the multiplication adds them up in the highest byte.
        let sum = (u64::from_le_bytes(*eight) & 0x8040_2010_0804_0201).wrapping_mul(0x0101_0101_0101_0101) >> 56;
        bits |= sum << (8 * number);
    }
    bits
}

/// The lanes whose bits are set.
#[inline(always)]
fn lanes(mut bits: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let lane = bits.trailing_zeros() as usize;
        // Without the lowest bit.
        (bits != 0).then(|| bits &= bits - 1).map(|()| lane)
    })
}

impl Block {
    fn new(pixels: &[(i8, i8)]) -> Self {
        let mut block = Block { steps: [0; LANES], x: [0; LANES], y: [0; LANES], left_of: [0; CUTS], above: [0; CUTS] };
        for (lane, (x, y)) in pixels.iter().enumerate() {
            (block.x[lane], block.y[lane]) = (*x, *y);
            block.steps[lane] = (i16::from(*x) * SCREEN as i16 + i16::from(*y)) * 3;
            for (cut, bits) in block.left_of.iter_mut().enumerate() {
                *bits |= u64::from(i16::from(*x) < cut as i16 - MAX_DISTANCE) << lane;
            }
            for (cut, bits) in block.above.iter_mut().enumerate() {
                *bits |= u64::from(i16::from(*y) < cut as i16 - MAX_DISTANCE) << lane;
            }
        }
        block
    }

    /// A bit for each pixel on the screen below the bar.
    #[inline(always)]
    fn visible(&self, from: &Circle) -> u64 {
        let cut = |edge: i16, centre: i16| (edge - centre + MAX_DISTANCE).clamp(0, CUTS as i16 - 1) as usize;
        let columns = self.left_of[cut(SCREEN as i16, from.x)] & !self.left_of[cut(0, from.x)];
        columns & self.above[cut(SCREEN as i16, from.y)] & !self.above[cut(BAR_HEIGHT as i16, from.y)]
    }

    /// Copies some pixels, which must be on the screen.
    #[inline(always)]
    fn copy(&self, pixels: u64, circle: &Circle, from: &Frame, to: &mut Frame) {
        let centre = (isize::from(circle.x) * SCREEN as isize + isize::from(circle.y)) * 3;
        for lane in lanes(pixels) {
            let start = (centre + isize::from(self.steps[lane % LANES])) as usize;
            let pixel = start..start + 3;
            // Never off the frame; without a panic, which would be a call in the loop.
            let (Some(from), Some(to)) = (from[..].get(pixel.clone()), to.get_mut(pixel)) else { return };
            to.copy_from_slice(from);
        }
    }

    /// A bit for each of the first `N` pixels that any of some circles lights. At least one of its pixels must be within reach of each.
    #[inline(always)]
    fn lit_by<'a, const N: usize>(&self, from: &Circle, circles: impl Iterator<Item = (Circle, &'a Extent)>) -> u64 {
        let mut is_lit = [0; N];
        for (circle, extent) in circles {
            let (right, down) = (from.x - circle.x, from.y - circle.y);
            let pixels = self.x.iter().zip(&self.y).map(|(x, y)| (right + i16::from(*x), down + i16::from(*y)));
            let lanes = is_lit.iter_mut().zip(pixels);
            if let Some(limit) = extent.limit {
                lanes.for_each(|(is_lit, (x, y))| *is_lit |= if distance(x, y) < limit { u8::MAX } else { 0 });
            } else {
                let is_inside = |x: i16, y: i16| extent.disc.contains((x.into(), y.into()));
                lanes.for_each(|(is_lit, (x, y))| *is_lit |= if is_inside(x, y) { u8::MAX } else { 0 });
            }
        }
        bits(&is_lit)
    }
}

#[cfg(test)]
mod tests {
    use super::super::shape::Shape;
    use super::*;
    use crate::envs::screen::FRAME_BYTES;

    fn circle(x: i16, y: i16, radius: i16) -> Circle {
        Circle { x, y, radius }
    }

    fn is_lit(circle: &Circle, (x, y): (i32, i32)) -> bool {
        Shape::of(circle.radius).extent.disc.contains((x - i32::from(circle.x), y - i32::from(circle.y)))
    }

    #[test]
    fn crescents_are_what_a_move_leaves_and_enters() {
        let shape = Shape::of(9);
        assert_eq!(shape.crescents((0, 0)).blocks.len(), 0);
        let down = shape.crescents((0, 1));
        assert_eq!(
            (down.left, down.blocks[0].visible(&circle(40, 40, 9)).count_ones()),
            (18, 36),
            "a pixel in each column at either end"
        );
        assert_eq!(down.bounds_of_left(&circle(20, 30, 9)), Edges::from(&Rect::new(11, 21, 18, 8)));
        assert_eq!(Shape::of(0).crescents((1, 0)).blocks.len(), 0);
        assert!(
            Shape::of(MAX_MOVED_RADIUS).crescents((REACH, REACH)).blocks.len() > 1,
            "more than one block is tested"
        );
    }

    #[test]
    fn moves_are_painted_as_two_frames_differ() {
        let (dark, lit, unknown) = ([1; FRAME_BYTES], [2; FRAME_BYTES], [0; FRAME_BYTES]);
        // The last two are as far off the screen as a circle that is partly on it can be.
        let (first, last) = (1 - MAX_MOVED_RADIUS, SCREEN as i16 + MAX_MOVED_RADIUS - 1);
        let centres = [(40, 40), (-3, 30), (SCREEN as i16 + 2, 61), (50, -1), (20, SCREEN as i16 - 2), (2, 5)];
        let centres = centres.into_iter().chain([(first, BAR_HEIGHT as i16), (last, SCREEN as i16 - 1)]);
        for radius in [1, 7, MAX_MOVED_RADIUS] {
            for (x, y) in centres.clone() {
                // Of all sizes, one with the least radius that has no limit, overlapping, apart, and at the edge.
                let others =
                    [circle(x + 9, y - 4, 11), circle(x - 30, y, 25), circle(x, y + 200, 200), circle(x, y, 3)];
                for (right, down) in [(1, 0), (0, -1), (-1, 2), (REACH, REACH), (-REACH, 0), (0, 0)] {
                    let (from, to) = (circle(x, y, radius), circle(x + right, y + down, radius));
                    for others in [&others[..0], &others[..1], &others] {
                        let mut frame = unknown;
                        let crescents = Shape::of(radius).crescents((right, down));
                        let lit_by = others.iter().map(|other| (*other, &Shape::of(other.radius).extent));
                        let lit_by = (!others.is_empty()).then_some(lit_by);
                        crescents.paint(&from, lit_by.clone(), [&dark, &lit], &mut frame);
                        let mut noted: Vec<_> = crescents.painted(&from, lit_by).collect();
                        noted.sort_unstable();
                        let mut painted = Vec::new();
                        for (pixel, found) in frame.as_chunks::<3>().0.iter().enumerate() {
                            let pixel = (pixel / SCREEN, pixel % SCREEN);
                            let (x, y) = (pixel.0 as i32, pixel.1 as i32);
                            let by_others = others.iter().any(|circle| is_lit(circle, (x, y)));
                            let [before, now] = [&from, &to].map(|circle| is_lit(circle, (x, y)));
                            let is_changed = before != now && !(before && by_others) && y >= BAR_HEIGHT as i32;
                            let expected = if !is_changed { 0 } else { 1 + u8::from(now) };
                            assert_eq!(*found, [expected; 3], "{from:?} to {to:?} at {pixel:?}");
                            painted.extend(is_changed.then_some(pixel));
                        }
                        assert_eq!(noted, painted);
                    }
                }
            }
        }
    }
}
