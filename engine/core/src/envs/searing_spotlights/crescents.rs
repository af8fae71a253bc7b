//! The pixels whose light changes when a circle moves: the crescent that it leaves and the one that it enters.

use smallvec::SmallVec;

use super::circle::Circle;
use super::config::BAR_HEIGHT;
use super::extent::{Extent, distance};
use crate::envs::screen::{FRAME_BYTES, Frame, SCREEN};
use crate::raster::{Disc, Rect};

/// Pixels of a block. Most moves change fewer.
const LANES: usize = 64;

/// The largest byte offset of a pixel in a frame.
const LAST_PIXEL: u16 = (FRAME_BYTES - 3) as u16;

/// Pixels side by side, relative to a circle's centre, so that vector instructions find where all of them are and whether they are
/// lit.
#[derive(Clone, Copy, Debug)]
struct Block {
    x: [i8; LANES],
    y: [i8; LANES],
}

/// The pixels that change when a circle moves.
#[derive(Debug)]
pub(super) struct Crescents {
    /// Relative to the centre before the move: the pixels that the circle leaves, and then those that it enters. Each in the order of
    /// their directions from the centre, so that those off the screen are few runs, and the branch on them is mostly predicted.
    blocks: SmallVec<[Block; 1]>,
    /// Number of pixels that the circle leaves.
    left: usize,
    /// Number of all pixels.
    len: usize,
    /// The smallest rectangle around the pixels that the circle leaves, relative to the centre before the move.
    bounds: Rect,
}

impl Crescents {
    /// The changes when a disc moves by `to`.
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
        let direction = |(x, y): &(i32, i32)| f64::from(2 * y + 1).atan2(f64::from(2 * x + 1));
        for (pixels, away) in [(&mut left, (-to.0, -to.1)), (&mut entered, to)] {
            // From the direction that the crescent is farthest from, in which it has no pixel.
            let start = f64::from(-away.1).atan2(f64::from(-away.0));
            let turn = |pixel: &(i32, i32)| (direction(pixel) - start).rem_euclid(std::f64::consts::TAU);
            pixels.sort_by(|one, other| turn(one).total_cmp(&turn(other)));
        }
        let pixel = |(x, y): &(i32, i32)| Rect::new(*x, *y, 1, 1);
        let bounds = left.iter().map(pixel).reduce(|all, pixel| all.union(&pixel)).unwrap_or_default();
        let all: Vec<_> = left.iter().chain(&entered).collect();
        let block = |pixels: &[&(i32, i32)]| {
            let mut block = Block { x: [0; LANES], y: [0; LANES] };
            for (lane, (x, y)) in pixels.iter().enumerate() {
                (block.x[lane], block.y[lane]) = (*x as i8, *y as i8);
            }
            block
        };
        Crescents { blocks: all.chunks(LANES).map(block).collect(), left: left.len(), len: all.len(), bounds }
    }

    /// The smallest rectangle around the pixels that a circle leaves.
    #[inline]
    pub fn bounds_of_left(&self, circle: &Circle) -> Rect {
        let (x, y) = circle.centre();
        Rect { x: self.bounds.x + x, y: self.bounds.y + y, ..self.bounds }
    }

    /// Paints the background of the pixels on the screen below the bar.
    ///
    /// Left pixels that are lit by none of `others` are copied from the frame `dark`, all others from `lit`.
    #[inline]
    pub fn paint<'a>(
        &self,
        from: &Circle,
        others: impl Iterator<Item = (Circle, &'a Extent)> + Clone,
        [dark, lit]: [&Frame; 2],
        frame: &mut Frame,
    ) {
        for (number, block) in self.blocks.iter().enumerate() {
            let first = number * LANES;
            let left = self.left.saturating_sub(first);
            let mut is_lit = from_number(left);
            for (other, extent) in others.clone() {
                // The circle itself lights what it enters. Most crescents have fewer pixels than half a block.
                if left <= LANES / 2 {
                    block.add_lit_by::<{ LANES / 2 }>(from, &other, extent, &mut is_lit);
                } else {
                    block.add_lit_by::<LANES>(from, &other, extent, &mut is_lit);
                }
            }
            let pixels = block.offsets(from);
            let count = LANES.min(self.len - first);
            for (pixel, is_lit) in pixels[..count].iter().zip(&is_lit[..count]) {
                if *pixel <= LAST_PIXEL {
                    let pixel = usize::from(*pixel)..usize::from(*pixel) + 3;
                    let source = if *is_lit != 0 { lit } else { dark };
                    frame[pixel.clone()].copy_from_slice(&source[pixel]);
                }
            }
        }
    }

    /// The pixels on the screen below the bar.
    pub fn on_screen(&self, from: &Circle) -> impl Iterator<Item = (usize, usize)> {
        let pixels = self.blocks.iter().flat_map(|block| block.offsets(from)).take(self.len);
        pixels.filter(|pixel| *pixel <= LAST_PIXEL).map(|pixel| {
            let pixel = usize::from(pixel) / 3;
            (pixel / SCREEN, pixel % SCREEN)
        })
    }
}

/// [`u16::MAX`] in the lanes from a number on, 0 in those before.
#[inline]
fn from_number(first: usize) -> [u16; LANES] {
    const STEP: [u16; 2 * LANES] = {
        let mut step = [0; 2 * LANES];
        let mut lane = LANES;
        while lane < 2 * LANES {
            step[lane] = u16::MAX;
            lane += 1;
        }
        step
    };
    *STEP[LANES - first.min(LANES)..].first_chunk().expect("as many lanes are left")
}

impl Block {
    /// The byte offset of each pixel in a frame; more than [`LAST_PIXEL`] if it is not on the screen below the bar.
    #[inline]
    fn offsets(&self, from: &Circle) -> [u16; LANES] {
        const HEIGHT: u16 = (SCREEN - BAR_HEIGHT) as u16;
        let mut offsets = [0; LANES];
        for (lane, offset) in offsets.iter_mut().enumerate() {
            let (x, y) = (from.x + i16::from(self.x[lane]), from.y + i16::from(self.y[lane]));
            // Columns off the screen have offsets behind the last pixel; those to its left wrap around. That holds from -176 to 259,
            // and a circle that is partly on the screen changes pixels from -50 to 133 only.
            *offset = (x as u16).wrapping_mul(3 * SCREEN as u16).wrapping_add((y as u16).wrapping_mul(3));
            let is_visible = (y as u16).wrapping_sub(BAR_HEIGHT as u16) < HEIGHT;
            *offset |= if is_visible { 0 } else { u16::MAX };
        }
        offsets
    }

    /// Sets those of the first `N` lanes whose pixels a circle lights to [`u16::MAX`].
    #[inline]
    fn add_lit_by<const N: usize>(&self, from: &Circle, circle: &Circle, extent: &Extent, is_lit: &mut [u16; LANES]) {
        let (right, down) = (from.x - circle.x, from.y - circle.y);
        let pixels = self.x.iter().zip(&self.y).map(|(x, y)| (right + i16::from(*x), down + i16::from(*y)));
        let lanes = is_lit[..N].iter_mut().zip(pixels);
        if let Some(limit) = extent.limit {
            lanes.for_each(|(is_lit, (x, y))| *is_lit |= if distance(x, y) < limit { u16::MAX } else { 0 });
        } else {
            let is_inside = |x: i16, y: i16| extent.disc.contains((x.into(), y.into()));
            lanes.for_each(|(is_lit, (x, y))| *is_lit |= if is_inside(x, y) { u16::MAX } else { 0 });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::shape::{MAX_MOVED_RADIUS, REACH, Shape};
    use super::*;

    fn circle(x: i16, y: i16, radius: i16) -> Circle {
        Circle { x, y, radius }
    }

    fn is_lit(circle: &Circle, (x, y): (i32, i32)) -> bool {
        Shape::of(circle.radius).extent.disc.contains((x - i32::from(circle.x), y - i32::from(circle.y)))
    }

    #[test]
    fn crescents_are_what_a_move_leaves_and_enters() {
        let shape = Shape::of(9);
        assert_eq!(shape.crescents((0, 0)).len, 0);
        let down = shape.crescents((0, 1));
        assert_eq!((down.left, down.len), (18, 36), "a pixel in each column at either end");
        assert_eq!(down.bounds_of_left(&circle(20, 30, 9)), Rect::new(11, 21, 18, 8));
        assert_eq!(Shape::of(0).crescents((1, 0)).len, 0);
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
                        crescents.paint(&from, lit_by, [&dark, &lit], &mut frame);
                        let mut noted: Vec<_> = crescents.on_screen(&from).collect();
                        noted.sort_unstable();
                        let mut painted = Vec::new();
                        for (pixel, found) in frame.as_chunks::<3>().0.iter().enumerate() {
                            let pixel = (pixel / SCREEN, pixel % SCREEN);
                            let (x, y) = (pixel.0 as i32, pixel.1 as i32);
                            let is_changed = is_lit(&from, (x, y)) != is_lit(&to, (x, y)) && y >= BAR_HEIGHT as i32;
                            let now = std::iter::once(&to).chain(others).any(|circle| is_lit(circle, (x, y)));
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
