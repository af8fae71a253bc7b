//! Precomputed shapes of the lit circles, created once per process.

use std::sync::OnceLock;

use super::crescents::{Crescents, MAX_MOVED_RADIUS, REACH};
use super::extent::Extent;
use super::parameters::MAX_SPOT_RADIUS;
use crate::raster::{Canvas, blend_keyed, circle_outline};

/// Number of different moves along one axis.
const MOVES: usize = 2 * REACH as usize + 1;

/// The shape of all circles of one radius.
#[derive(Debug)]
pub(super) struct Shape {
    pub extent: Extent,
    /// How far the disc's column of that number begins below the top of a disc of [`MAX_MOVED_RADIUS`] about the same centre, and
    /// ends above its bottom; [`u8::MAX`] for a column without a pixel.
    pub margins: [u8; 2 * MAX_MOVED_RADIUS as usize],
    outline: Vec<(i32, i32)>,
    /// By the move along both axes.
    crescents: Vec<Crescents>,
}

impl Shape {
    /// The shape for a radius of 0 to [`MAX_SPOT_RADIUS`].
    ///
    /// # Panics
    ///
    /// For any other radius.
    #[inline(always)]
    pub fn of(radius: i16) -> &'static Shape {
        static SHAPES: [OnceLock<Shape>; MAX_SPOT_RADIUS as usize + 1] =
            [const { OnceLock::new() }; MAX_SPOT_RADIUS as usize + 1];
        SHAPES[radius as usize].get_or_init(|| Shape::new(radius.into()))
    }

    fn new(radius: i32) -> Self {
        let extent = Extent::new(radius);
        let disc = &extent.disc;
        let reach = -i32::from(REACH)..=i32::from(REACH);
        let moves = reach.clone().flat_map(|x| reach.clone().map(move |y| (x, y)));
        let crescents = if radius > MAX_MOVED_RADIUS.into() {
            Vec::new()
        } else {
            moves.map(|to| Crescents::new(disc, to)).collect()
        };
        let mut margins = [u8::MAX; 2 * MAX_MOVED_RADIUS as usize];
        if !crescents.is_empty() {
            for (margin, x) in margins.iter_mut().zip(-radius..radius) {
                *margin = (i32::from(MAX_MOVED_RADIUS) - disc.half_height(x.into())) as u8;
            }
        }
        Shape { extent, margins, outline: circle_outline(radius), crescents }
    }

    /// Whether the crescent of a move is precomputed.
    #[inline(always)]
    pub fn is_precomputed(radius: i16, (x, y): (i16, i16)) -> bool {
        let is_near = |distance: i16| (distance + REACH) as u16 <= 2 * REACH as u16;
        is_near(x) & is_near(y) & (radius <= MAX_MOVED_RADIUS)
    }

    /// The pixels that change when the circle moves. The caller must have checked [`is_precomputed`](Shape::is_precomputed).
    #[inline(always)]
    pub fn crescents(&self, (x, y): (i16, i16)) -> &Crescents {
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
    fn short_moves_of_small_circles_are_precomputed() {
        assert!(Shape::is_precomputed(9, (REACH, -REACH)));
        assert!(!Shape::is_precomputed(9, (REACH + 1, 0)));
        assert!(!Shape::is_precomputed(9, (0, -REACH - 1)));
        assert!(!Shape::is_precomputed(MAX_SPOT_RADIUS as i16, (1, 0)));
    }
}
