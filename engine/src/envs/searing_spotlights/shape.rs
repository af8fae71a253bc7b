//! The circles that spotlights light up, made once for the whole process.

use std::sync::OnceLock;

use super::parameters::MAX_SPOT_RADIUS;
use crate::raster::{Canvas, Disc, blend_keyed, circle_outline};

/// How far a circle may have moved for what changes to be known beforehand, in pixels along each axis.
pub(super) const REACH: i16 = 3;

/// Moves along one axis.
const MOVES: usize = 2 * REACH as usize + 1;

/// Largest radius whose moves are known beforehand; what a larger circle lights is painted anew.
const MAX_MOVED_RADIUS: i32 = 24;

/// A circle of some radius.
#[derive(Debug)]
pub(super) struct Shape {
    pub disc: Disc,
    outline: Vec<(i32, i32)>,
    /// By how far the circle moves along both axes: the pixels that it leaves, from its centre.
    crescents: Vec<Vec<(i8, i8)>>,
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
        let crescents =
            if radius > MAX_MOVED_RADIUS { Vec::new() } else { moves.map(|to| crescent(&disc, to)).collect() };
        Shape { disc, outline: circle_outline(radius), crescents }
    }

    /// The pixels that a circle leaves which moves so far, from its old centre; `None` where that is not known beforehand.
    #[inline]
    pub fn crescent(&self, (x, y): (i16, i16)) -> Option<&[(i8, i8)]> {
        let (column, row) = ((x + REACH) as usize, (y + REACH) as usize);
        if column >= MOVES || row >= MOVES {
            return None;
        }
        self.crescents.get(column * MOVES + row).map(Vec::as_slice)
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

/// The pixels of a disc, from its centre, that are not on the same disc at `to`.
fn crescent(disc: &Disc, to: (i32, i32)) -> Vec<(i8, i8)> {
    let radius = disc.radius();
    let pixels = (-radius..radius).flat_map(|x| (-radius..radius).map(move |y| (x, y)));
    pixels
        .filter(|(x, y)| disc.contains((*x, *y)) && !disc.contains((x - to.0, y - to.1)))
        .map(|(x, y)| (x as i8, y as i8))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crescent_is_what_a_move_leaves() {
        let shape = Shape::of(9);
        assert_eq!(shape.crescent((0, 0)), Some(&[][..]));
        assert_eq!(shape.crescent((0, 1)).unwrap().len(), 18, "a pixel in each column");
        assert_eq!(shape.crescent((-2, 3)).unwrap().len(), shape.crescent((2, -3)).unwrap().len());
        assert_eq!(shape.crescent((REACH + 1, 0)), None);
        assert_eq!(shape.crescent((0, -REACH - 1)), None);
        assert_eq!(Shape::of(MAX_SPOT_RADIUS as i16).crescent((1, 0)), None);
        assert_eq!(Shape::of(0).crescent((1, 0)), Some(&[][..]));
    }
}
