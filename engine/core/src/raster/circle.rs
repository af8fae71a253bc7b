//! Circles: filled, thin, or with a wide border.
//!
//! pygame's circles have an even diameter: about the centre `(x, y)`, the distance 1 is the column `x` to the right and the
//! column `x - 1` to the left, and likewise for the rows.

use std::ops::Range;

use super::canvas::Canvas;
use super::runs::{Rgb, clip, fill_run};

/// Maximum radius; larger ones are clamped, to bound the time.
const MAX_RADIUS: i64 = 1 << 16;

/// Whether the midpoint that follows the point `(x, y)` of an outline lies outside the circle, so that the outline moves one
/// pixel towards the centre.
pub(super) fn midpoint_is_outside(radius: i64, x: i64, y: i64) -> bool {
    (x + 1) * (x + 1) + y * (y - 1) >= radius * radius
}

/// The points of an eighth of a circle by the midpoint rule: distances `(x, y)` from the centre, in the order of `x`.
#[derive(Clone, Debug)]
pub(super) struct Octant {
    radius: i64,
    x: i64,
    y: i64,
}

impl Octant {
    pub(super) fn new(radius: i64) -> Self {
        Self { radius, x: 0, y: radius }
    }
}

impl Iterator for Octant {
    type Item = (i64, i64);

    fn next(&mut self) -> Option<(i64, i64)> {
        if self.x >= self.y {
            return None;
        }
        self.y -= i64::from(midpoint_is_outside(self.radius, self.x, self.y));
        self.x += 1;
        Some((self.x, self.y))
    }
}

/// A filled circle, compiled to one run per column, for painting anywhere.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Disc {
    /// Half the height of each column's run, by the column's distance from the centre, from 1.
    half_heights: Vec<i32>,
}

/// A column of a [`Disc`] on a canvas: the pixels `(x, y)` for all `y` in `rows`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DiscColumn {
    /// The column, from the canvas' left edge.
    pub x: usize,
    /// The rows, from the canvas' top edge.
    pub rows: Range<usize>,
}

impl Disc {
    /// The disc that `pygame.draw.circle` fills; empty for radii below 1.
    pub fn new(radius: i32) -> Self {
        let radius = i64::from(radius).clamp(0, MAX_RADIUS);
        let mut half_heights = vec![0; radius as usize];
        for (x, y) in Octant::new(radius) {
            // pygame swaps the ends of a run that ends before it starts, so no run is empty.
            half_heights[x as usize - 1] = y.max(1) as i32;
            // Of all points with the same `y`, the last is the farthest out.
            if y > 0 && midpoint_is_outside(radius, x, y) {
                let half_height = &mut half_heights[y as usize - 1];
                *half_height = (*half_height).max(x as i32);
            }
        }
        Self { half_heights }
    }

    /// The radius in pixels.
    pub fn radius(&self) -> i32 {
        self.half_heights.len() as i32
    }

    /// The nonempty runs of the disc about `center` that lie in some columns and rows, from left to right.
    #[inline]
    pub fn columns(
        &self,
        center: (i32, i32),
        columns: &Range<usize>,
        rows: Range<usize>,
    ) -> impl Iterator<Item = DiscColumn> + '_ {
        let center_x = i64::from(center.0);
        let radius = i64::from(self.radius());
        clip(center_x - radius, center_x + radius - 1, columns).filter_map(move |x| {
            let rows = self.rows(center, x, &rows);
            (!rows.is_empty()).then_some(DiscColumn { x, rows })
        })
    }

    /// Half height of the column at distance `x` from the centre; 0 beyond the disc.
    #[inline]
    pub fn half_height(&self, x: i64) -> i32 {
        // The disc is symmetric: the column -1 is as far from the centre as the column 0.
        self.half_heights.get((x ^ (x >> 63)) as usize).copied().unwrap_or(0)
    }

    /// Whether the disc covers the pixel at the offset `(x, y)` from its centre.
    #[inline]
    pub fn contains(&self, (x, y): (i32, i32)) -> bool {
        // The disc is symmetric: the column -1 is as far from the centre as the column 0.
        let distance = |from_centre: i32| from_centre ^ (from_centre >> 31);
        self.half_heights.get(distance(x) as usize).is_some_and(|half| distance(y) < *half)
    }

    /// The part of `rows` in the column `x` that the disc about `center` covers.
    #[inline]
    pub fn rows(&self, center: (i32, i32), x: usize, rows: &Range<usize>) -> Range<usize> {
        let half = i64::from(self.half_height(x as i64 - i64::from(center.0)));
        let center_y = i64::from(center.1);
        clip(center_y - half, center_y + half - 1, rows)
    }
}

/// The pixels of a circle with a border of one pixel, relative to its centre, without duplicates; empty for radii below 1. All
/// of them lie on the [`Disc`] of the same radius.
pub fn circle_outline(radius: i32) -> Vec<(i32, i32)> {
    let mut pixels: Vec<(i32, i32)> = Octant::new(i64::from(radius).clamp(0, MAX_RADIUS))
        .map(|(near, far)| (near as i32, far as i32))
        .flat_map(|(near, far)| [(near, far), (far, near)])
        .flat_map(|(x, y)| [(-x, -y), (x - 1, -y), (-x, y - 1), (x - 1, y - 1)])
        .collect();
    pixels.sort_unstable();
    pixels.dedup();
    pixels
}

/// The outline of a circle with a wide border: one point per row, downwards from the top, by two midpoint rules that meet on
/// the diagonal.
struct Contour {
    radius: i64,
    x: i64,
    y: i64,
}

impl Contour {
    fn new(radius: i64) -> Self {
        Self { radius, x: 0, y: radius }
    }

    /// Whether the contour is still in the flat part, where a row is wider than one point.
    fn is_flat(&self) -> bool {
        self.x < self.y
    }

    /// Moves along the row to its farthest point; only for the flat part.
    fn widen(&mut self) {
        let outside = 4 * self.radius * self.radius;
        while 4 * (self.x + 1).pow(2) + (2 * self.y - 1).pow(2) < outside {
            self.x += 1;
        }
    }

    /// Moves diagonally to the next row; only for the flat part.
    fn descend_flat(&mut self) {
        self.x += 1;
        self.y -= 1;
    }

    /// Moves to the next row in the steep part.
    fn descend_steep(&mut self) {
        let outside = 4 * self.radius * self.radius;
        if (2 * self.x + 1).pow(2) + 4 * (self.y - 1).pow(2) <= outside {
            self.x += 1;
        }
        self.y -= 1;
    }
}

impl Canvas<'_> {
    /// Draws a circle as `pygame.draw.circle` does. Lengths are in pixels.
    ///
    /// A `width` of 0, or of at least the radius, fills the circle; otherwise `width` is the thickness of its border, which
    /// grows inwards. Nothing is drawn for a `radius` below 1 or a negative `width`. Exact for radii up to 46340, beyond which
    /// pygame's own numbers overflow.
    pub fn draw_circle(&mut self, color: Rgb, center: (i32, i32), radius: i32, width: i32) {
        if radius < 1 || width < 0 {
            return;
        }
        if width == 0 || width >= radius {
            self.fill_disc(color, center, &Disc::new(radius));
            return;
        }
        let x = i64::from(center.0);
        let y = i64::from(center.1);
        let radius = i64::from(radius).min(MAX_RADIUS);
        if width == 1 {
            self.draw_thin_circle(color, x, y, radius);
        } else {
            let width = i64::from(width).min(radius);
            self.draw_ring(color, x, y, radius, width);
        }
    }

    /// Fills a circle with a compiled [`Disc`]: the same pixels as [`Canvas::draw_circle`].
    pub fn fill_disc(&mut self, color: Rgb, center: (i32, i32), disc: &Disc) {
        for DiscColumn { x, rows } in disc.columns(center, &self.columns(), self.rows()) {
            fill_run(self.run_mut(x, rows), color);
        }
    }

    fn draw_thin_circle(&mut self, color: Rgb, center_x: i64, center_y: i64, radius: i64) {
        for (near, far) in Octant::new(radius) {
            for (x, y) in [(near, far), (far, near)] {
                for column in [center_x - x, center_x + x - 1] {
                    self.put(column, center_y - y, color);
                    self.put(column, center_y + y - 1, color);
                }
            }
        }
    }

    fn draw_ring(&mut self, color: Rgb, center_x: i64, center_y: i64, radius: i64, width: i64) {
        let inner_radius = radius - width + 1;
        let mut outer = Contour::new(radius);
        let mut inner = Contour::new(inner_radius);
        let mut is_hollow = false;
        while outer.y >= 0 {
            // Decided before widening the row, which may end the flat part.
            let is_flat = outer.is_flat();
            if is_flat {
                outer.widen();
            }
            let (left, right) = (center_x - outer.x, center_x + outer.x - 1);
            for row in [center_y - outer.y, center_y + outer.y - 1] {
                if is_hollow {
                    self.fill_row(left, center_x - inner.x, row, color);
                    self.fill_row(center_x + inner.x - 1, right, row, color);
                } else {
                    self.fill_row(left, right, row, color);
                }
            }
            if is_flat {
                outer.descend_flat();
            } else {
                outer.descend_steep();
            }
            is_hollow = is_hollow || outer.y < inner_radius;
            if is_hollow {
                if inner.is_flat() {
                    inner.widen();
                    inner.descend_flat();
                } else {
                    inner.descend_steep();
                }
            }
        }
    }
}
