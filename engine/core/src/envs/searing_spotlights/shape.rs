//! Precomputed shapes of the lit circles, created once per process.

use std::ops::Range;
use std::sync::OnceLock;

use super::parameters::MAX_SPOT_RADIUS;
use crate::envs::screen::{FRAME_BYTES, Frame, SCREEN};
use crate::raster::{Canvas, Disc, Rect, blend_keyed, circle_outline};

/// Longest move along each axis whose crescents are precomputed, in pixels.
pub(super) const REACH: i16 = 3;

/// Number of different moves along one axis.
const MOVES: usize = 2 * REACH as usize + 1;

/// Largest radius whose crescents are precomputed. Larger circles are repainted in full.
pub(super) const MAX_MOVED_RADIUS: i16 = 24;

/// The shape of all circles of one radius.
#[derive(Debug)]
pub(super) struct Shape {
    pub disc: Disc,
    /// How far the disc's column of that number begins below the top of a disc of [`MAX_MOVED_RADIUS`] about the same centre, and
    /// ends above its bottom; [`u8::MAX`] for a column without a pixel.
    pub margins: [u8; 2 * MAX_MOVED_RADIUS as usize],
    outline: Vec<(i32, i32)>,
    /// By the move along both axes.
    crescents: Vec<Crescent>,
}

/// The pixels that a circle leaves when it moves.
#[derive(Debug, Default)]
pub(super) struct Crescent {
    /// Relative to the circle's centre, by row and then by column.
    pub pixels: Vec<(i8, i8)>,
    /// The smallest rectangle around them, relative to the circle's centre.
    pub bounds: Rect,
    /// The byte offset of each of `pixels` in a frame whose corner is the corner of the circle's bounds.
    offsets: Vec<u16>,
    /// For each row of the circle's bounds, and the one behind the last, the number of pixels above it.
    above: Vec<u16>,
}

impl Crescent {
    /// The pixels that a disc leaves when it moves by `to`.
    fn new(disc: &Disc, to: (i32, i32)) -> Self {
        let radius = disc.radius();
        let columns = -radius..radius;
        let left = |x: i32, y: i32| disc.contains((x, y)) && !disc.contains((x - to.0, y - to.1));
        let mut crescent = Crescent::default();
        for y in columns.clone() {
            crescent.above.push(crescent.pixels.len() as u16);
            for x in columns.clone().filter(|x| left(*x, y)) {
                let pixel = Rect::new(x, y, 1, 1);
                crescent.bounds = if crescent.pixels.is_empty() { pixel } else { crescent.bounds.union(&pixel) };
                crescent.pixels.push((x as i8, y as i8));
                crescent.offsets.push(((x + radius) as usize * SCREEN + (y + radius) as usize) as u16 * 3);
            }
        }
        crescent.above.push(crescent.pixels.len() as u16);
        crescent
    }

    /// Copies the pixels in some rows of the screen from one frame to another, for a circle whose bounds have the given corner.
    /// Columns off the screen are skipped, since their offsets are outside of the frame.
    ///
    /// One loop over single pixels: with blocks of several lengths there are fewer copies, and more loops whose ends no processor
    /// predicts.
    #[inline]
    pub fn copy(&self, (x, y): (i32, i32), rows: &Range<i32>, from: &Frame, to: &mut Frame) {
        // A negative offset wraps around to a value outside of the frame, and back for the pixels that are on the screen.
        let corner = ((x * SCREEN as i32 + y) * 3) as usize;
        for offset in &self.offsets[self.in_rows(y, rows)] {
            copy_pixel(*offset, corner, from, to);
        }
    }

    /// As [`copy`](Self::copy), only the pixels in another disc with the given centre.
    #[inline]
    pub fn copy_within(
        &self,
        (x, y): (i32, i32),
        (disc, centre): (&Disc, (i32, i32)),
        rows: &Range<i32>,
        from: &Frame,
        to: &mut Frame,
    ) {
        let radius = self.above.len() as i32 / 2;
        let (right, down) = (x + radius - centre.0, y + radius - centre.1);
        let first = rows.start.max(centre.1 - disc.radius());
        let range = self.in_rows(y, &(first..rows.end.min(centre.1 + disc.radius()).max(first)));
        let corner = ((x * SCREEN as i32 + y) * 3) as usize;
        for (pixel, offset) in self.pixels[range.clone()].iter().zip(&self.offsets[range]) {
            if disc.contains((right + i32::from(pixel.0), down + i32::from(pixel.1))) {
                copy_pixel(*offset, corner, from, to);
            }
        }
    }

    /// The pixels in some rows of the screen, for a circle whose bounds begin at the row `y`.
    #[inline]
    fn in_rows(&self, y: i32, rows: &Range<i32>) -> Range<usize> {
        let above = |row: i32| {
            let row = (row - y).clamp(0, self.above.len() as i32 - 1);
            usize::from(self.above[row as usize])
        };
        above(rows.start)..above(rows.end)
    }
}

#[inline]
fn copy_pixel(offset: u16, corner: usize, from: &Frame, to: &mut Frame) {
    let pixel = corner.wrapping_add(usize::from(offset));
    if pixel <= FRAME_BYTES - 3 {
        to[pixel..pixel + 3].copy_from_slice(&from[pixel..pixel + 3]);
    }
}

impl Shape {
    /// The shape for a radius of 0 to [`MAX_SPOT_RADIUS`].
    ///
    /// # Panics
    ///
    /// For any other radius.
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
        let mut margins = [u8::MAX; 2 * MAX_MOVED_RADIUS as usize];
        if !crescents.is_empty() {
            for (margin, x) in margins.iter_mut().zip(-radius..radius) {
                *margin = (i32::from(MAX_MOVED_RADIUS) - disc.half_height(x.into())) as u8;
            }
        }
        Shape { disc, margins, outline: circle_outline(radius), crescents }
    }

    /// Whether the crescent of a move is precomputed.
    #[inline]
    pub fn is_precomputed(radius: i16, (x, y): (i16, i16)) -> bool {
        let is_near = |distance: i16| (distance + REACH) as u16 <= 2 * REACH as u16;
        is_near(x) & is_near(y) & (radius <= MAX_MOVED_RADIUS)
    }

    /// The pixels that the circle leaves when it moves. The caller must have checked
    /// [`is_precomputed`](Shape::is_precomputed).
    #[inline]
    pub fn crescent(&self, (x, y): (i16, i16)) -> &Crescent {
        &self.crescents[(x + REACH) as usize * MOVES + (y + REACH) as usize]
    }

    /// Draws the white outline, which the original paints on the translucent dark surface.
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
        assert!(Shape::is_precomputed(9, (REACH, -REACH)));
        assert!(!Shape::is_precomputed(9, (REACH + 1, 0)));
        assert!(!Shape::is_precomputed(9, (0, -REACH - 1)));
        assert!(!Shape::is_precomputed(MAX_SPOT_RADIUS as i16, (1, 0)));
        assert!(Shape::of(0).crescent((1, 0)).pixels.is_empty());
    }

    #[test]
    fn crescents_are_copied_where_they_are_on_the_screen() {
        let white = [255; FRAME_BYTES];
        let rows = 10..SCREEN as i32 - 3;
        for radius in 0..=MAX_MOVED_RADIUS {
            for crescent in &Shape::of(radius).crescents {
                for corner in [(5, 12), (-5, 30), (SCREEN as i32 - 4, -7), (20, SCREEN as i32 - 9)] {
                    let (mut found, mut expected) = ([0; FRAME_BYTES], [0; FRAME_BYTES]);
                    crescent.copy(corner, &rows, &white, &mut found);
                    for (x, y) in crescent.pixels.iter().map(|(x, y)| (i32::from(*x), i32::from(*y))) {
                        assert!(crescent.bounds.overlaps(&Rect::new(x, y, 1, 1)));
                        let (x, y) = (corner.0 + i32::from(radius) + x, corner.1 + i32::from(radius) + y);
                        if (0..SCREEN as i32).contains(&x) && rows.contains(&y) {
                            expected.as_chunks_mut::<3>().0[x as usize * SCREEN + y as usize] = [255; 3];
                        }
                    }
                    assert!(found == expected, "radius {radius} at {corner:?}");
                }
            }
        }
    }

    #[test]
    fn a_part_of_a_crescent_is_copied_within_another_disc() {
        let white = [255; FRAME_BYTES];
        let (rows, disc) = (0..SCREEN as i32, &Shape::of(8).disc);
        let crescent = Shape::of(11).crescent((2, -1));
        for centre in [(30, 30), (38, 22), (24, 41), (60, 60)] {
            let (mut found, mut expected) = ([0; FRAME_BYTES], [0; FRAME_BYTES]);
            crescent.copy_within((20, 20), (disc, centre), &rows, &white, &mut found);
            for (x, y) in crescent.pixels.iter().map(|(x, y)| (31 + i32::from(*x), 31 + i32::from(*y))) {
                if disc.contains((x - centre.0, y - centre.1)) {
                    expected.as_chunks_mut::<3>().0[x as usize * SCREEN + y as usize] = [255; 3];
                }
            }
            assert!(found == expected, "{centre:?}");
        }
    }
}
