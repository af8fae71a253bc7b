//! The circles that spotlights light up, made once for the whole process.

use std::sync::OnceLock;

use super::drawing::Frame;
use super::parameters::MAX_SPOT_RADIUS;
use crate::envs::{FRAME_BYTES, SCREEN};
use crate::raster::{Canvas, Disc, Rect, blend_keyed, circle_outline};

/// How far a circle may have moved for what changes to be known beforehand, in pixels along each axis.
pub(super) const REACH: i16 = 3;

/// Moves along one axis.
const MOVES: usize = 2 * REACH as usize + 1;

/// Largest radius whose moves are known beforehand; what a larger circle lights is painted anew.
const MAX_MOVED_RADIUS: i16 = 24;

/// A circle of some radius.
#[derive(Debug)]
pub(super) struct Shape {
    pub disc: Disc,
    outline: Vec<(i32, i32)>,
    /// By how far the circle moves along both axes.
    crescents: Vec<Crescent>,
}

/// The pixels that a circle leaves when it moves.
#[derive(Debug, Default)]
pub(super) struct Crescent {
    /// From the circle's centre.
    pub pixels: Vec<(i8, i8)>,
    /// The smallest rectangle about them, from the circle's centre.
    pub bounds: Rect,
    /// The same pixels as blocks, 1 to [`LONGEST`] pixels one below another, those of each length together. A block is the
    /// place of its first byte on a screen with the circle's bounds in its corner.
    blocks: Vec<u16>,
    /// Where the blocks of each length end.
    ends: [usize; LONGEST],
}

/// Pixels of the longest block. A longer run is several blocks, the last of which overlaps the one before it.
const LONGEST: usize = 4;

impl Crescent {
    /// What a disc leaves that moves by `to`.
    fn new(disc: &Disc, to: (i32, i32)) -> Self {
        let radius = disc.radius();
        let columns = -radius..radius;
        let left = |x: i32, y: &i32| disc.contains((x, *y)) && !disc.contains((x - to.0, y - to.1));
        let mut crescent = Crescent::default();
        let mut blocks: [Vec<u16>; LONGEST] = Default::default();
        for x in columns.clone() {
            let rows: Vec<i32> = columns.clone().filter(|y| left(x, y)).collect();
            for run in rows.chunk_by(|above, below| above + 1 == *below) {
                crescent.pixels.extend(run.iter().map(|y| (x as i8, *y as i8)));
                crescent.bounds = match crescent.bounds {
                    Rect { width: 0, .. } => Rect::new(x, run[0], 1, run.len() as i32),
                    bounds => bounds.union(&Rect::new(x, run[0], 1, run.len() as i32)),
                };
                let length = run.len().min(LONGEST);
                for start in (0..run.len()).step_by(length).map(|start| start.min(run.len() - length)) {
                    let place = (x + radius) as usize * SCREEN + (run[start] + radius) as usize;
                    blocks[length - 1].push(place as u16 * 3);
                }
            }
        }
        for (end, blocks) in crescent.ends.iter_mut().zip(blocks) {
            crescent.blocks.extend(blocks);
            *end = crescent.blocks.len();
        }
        crescent
    }

    /// Copies the pixels from a picture, for a circle all of whose rows are on the screen and whose bounds have their corner
    /// there. Columns to the left and to the right of the screen would lie before and behind the frame, and are left out.
    #[inline]
    pub fn copy(&self, (x, y): (i32, i32), from: &Frame, to: &mut Frame) {
        // Less than zero wraps to what no frame holds, and back with the blocks that are on the screen.
        let corner = ((x * SCREEN as i32 + y) * 3) as usize;
        let [ones, twos, threes, fours] = self.ends;
        copy_blocks::<3>(&self.blocks[..ones], corner, from, to);
        copy_blocks::<6>(&self.blocks[ones..twos], corner, from, to);
        copy_blocks::<9>(&self.blocks[twos..threes], corner, from, to);
        copy_blocks::<12>(&self.blocks[threes..fours], corner, from, to);
    }
}

#[inline]
fn copy_blocks<const N: usize>(blocks: &[u16], corner: usize, from: &Frame, to: &mut Frame) {
    for block in blocks {
        let block = corner.wrapping_add(usize::from(*block));
        if block <= FRAME_BYTES - N {
            to[block..block + N].copy_from_slice(&from[block..block + N]);
        }
    }
}

impl Shape {
    /// The circle of some radius, 0 to [`MAX_SPOT_RADIUS`].
    #[inline]
    pub fn of(radius: i16) -> &'static Shape {
        static SHAPES: [OnceLock<Shape>; MAX_SPOT_RADIUS as usize + 1] =
            [const { OnceLock::new() }; MAX_SPOT_RADIUS as usize + 1];
        SHAPES[radius as usize].get_or_init(|| Shape::new(radius.into()))
    }

    fn new(radius: i32) -> Self {
        let disc = Disc::new(radius);
        let reach = -i32::from(REACH)..=i32::from(REACH);
        let moves = reach.clone().flat_map(|x| reach.clone().map(move |y| (x, y)));
        let crescents = if radius > MAX_MOVED_RADIUS.into() {
            Vec::new()
        } else {
            moves.map(|to| Crescent::new(&disc, to)).collect()
        };
        Shape { disc, outline: circle_outline(radius), crescents }
    }

    /// Whether the crescent of a move is known beforehand.
    #[inline]
    pub fn is_known(radius: i16, (x, y): (i16, i16)) -> bool {
        let is_near = |way: i16| (-REACH..=REACH).contains(&way);
        is_near(x) && is_near(y) && radius <= MAX_MOVED_RADIUS
    }

    /// What a circle leaves which moves so far; [`is_known`](Shape::is_known) tells whether there is such a crescent.
    #[inline]
    pub fn crescent(&self, (x, y): (i16, i16)) -> &Crescent {
        &self.crescents[(x + REACH) as usize * MOVES + (y + REACH) as usize]
    }

    /// Draws the white outline of a half transparent surface over what the circle has brought back.
    pub fn draw_outline(&self, canvas: &mut Canvas<'_>, centre: (i32, i32), alpha: u8) {
        let (columns, rows) = (canvas.columns(), canvas.rows());
        for (x, y) in &self.outline {
            let (x, y) = ((centre.0 + x) as usize, (centre.1 + y) as usize);
            if columns.contains(&x) && rows.contains(&y) {
                let pixel = canvas.pixel_mut(x, y);
                *pixel = pixel.map(|channel| blend_keyed(255, channel, alpha));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crescent_is_what_a_move_leaves() {
        let shape = Shape::of(9);
        assert!(shape.crescent((0, 0)).pixels.is_empty());
        assert_eq!(shape.crescent((0, 1)).pixels.len(), 18, "a pixel in each column");
        assert_eq!(shape.crescent((-2, 3)).pixels.len(), shape.crescent((2, -3)).pixels.len());
        assert!(Shape::is_known(9, (REACH, -REACH)));
        assert!(!Shape::is_known(9, (REACH + 1, 0)));
        assert!(!Shape::is_known(9, (0, -REACH - 1)));
        assert!(!Shape::is_known(MAX_SPOT_RADIUS as i16, (1, 0)));
        assert!(Shape::of(0).crescent((1, 0)).pixels.is_empty());
    }

    #[test]
    fn the_blocks_of_a_crescent_are_its_pixels() {
        let white = [255; FRAME_BYTES];
        for radius in 0..=MAX_MOVED_RADIUS {
            for crescent in &Shape::of(radius).crescents {
                for corner in [(5, 9), (-5, 9), (SCREEN as i32 - 4, 9)] {
                    let mut found = [0; FRAME_BYTES];
                    crescent.copy(corner, &white, &mut found);
                    let mut expected = [0; FRAME_BYTES];
                    for (x, y) in crescent.pixels.iter().map(|(x, y)| (i32::from(*x), i32::from(*y))) {
                        assert!(crescent.bounds.overlaps(&Rect::new(x, y, 1, 1)));
                        let (x, y) = (corner.0 + i32::from(radius) + x, corner.1 + i32::from(radius) + y);
                        if (0..SCREEN as i32).contains(&x) {
                            expected.as_chunks_mut::<3>().0[x as usize * SCREEN + y as usize] = [255; 3];
                        }
                    }
                    assert!(found == expected, "radius {radius} at {corner:?}");
                }
            }
        }
    }
}
