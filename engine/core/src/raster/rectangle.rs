//! Drawing rectangles: filled or with a border, with square or rounded corners.

use super::canvas::Canvas;
use super::circle::{Octant, midpoint_is_outside};
use super::rect::{CornerRadii, Rect};
use super::runs::Rgb;

/// Maximum coordinate of a rounded rectangle; larger ones are clamped, to bound the time.
const MAX_COORDINATE: i64 = 1 << 16;

/// The outermost columns and rows of a rectangle, all within it.
#[derive(Clone, Copy)]
struct Edges {
    left: i64,
    top: i64,
    right: i64,
    bottom: i64,
}

impl Edges {
    fn of(rect: Rect) -> Self {
        let (left, top) = (i64::from(rect.x), i64::from(rect.y));
        Self { left, top, right: left + i64::from(rect.width) - 1, bottom: top + i64::from(rect.height) - 1 }
    }

    fn width(&self) -> i64 {
        self.right - self.left + 1
    }

    fn height(&self) -> i64 {
        self.bottom - self.top + 1
    }
}

/// The four radii as signed lengths.
#[derive(Clone, Copy)]
struct Corners {
    top_left: i64,
    top_right: i64,
    bottom_left: i64,
    bottom_right: i64,
}

impl Corners {
    /// The radii, all scaled down by one factor if two of them do not fit on their edge.
    fn fitting(radii: CornerRadii, edges: &Edges) -> Self {
        let corners = Self {
            top_left: radii.top_left.into(),
            top_right: radii.top_right.into(),
            bottom_left: radii.bottom_left.into(),
            bottom_right: radii.bottom_right.into(),
        };
        let needs = [
            (edges.width(), corners.top_left + corners.top_right),
            (edges.height(), corners.top_left + corners.bottom_left),
            (edges.width(), corners.bottom_left + corners.bottom_right),
            (edges.height(), corners.top_right + corners.bottom_right),
        ];
        if needs.iter().all(|&(length, needed)| needed <= length) {
            return corners;
        }
        // Single precision, as in pygame: it determines the truncation of the scaled radii.
        let factor = needs.iter().map(|&(length, needed)| length as f32 / needed as f32).fold(f32::INFINITY, f32::min);
        let scaled = |radius: i64| (radius as f32 * factor) as i64;
        Self {
            top_left: scaled(corners.top_left),
            top_right: scaled(corners.top_right),
            bottom_left: scaled(corners.bottom_left),
            bottom_right: scaled(corners.bottom_right),
        }
    }
}

impl Canvas<'_> {
    /// Draws a rectangle as `pygame.draw.rect` does.
    ///
    /// A `width` of 0 fills it; otherwise `width` is the thickness of its border in pixels, which grows inwards. A border that
    /// would leave no hole in the visible part fills that part. Nothing is drawn for a negative `width` or a `rect` whose width
    /// or height is below 1.
    pub fn draw_rect(&mut self, color: Rgb, rect: Rect, width: i32) {
        let Edges { left, top, right, bottom } = Edges::of(rect);
        let visible_width = right.min(self.width() as i64 - 1) - left.max(0) + 1;
        let visible_height = bottom.min(self.height() as i64 - 1) - top.max(0) + 1;
        if width < 0 || rect.width < 1 || rect.height < 1 || visible_width < 1 || visible_height < 1 {
            return;
        }
        let width = i64::from(width);
        if width == 0 || width * 2 >= visible_width.min(visible_height) {
            self.fill_block(left, top, right, bottom, color);
            return;
        }
        self.fill_block(left, top, right, top + width - 1, color);
        self.fill_block(left, bottom - width + 1, right, bottom, color);
        self.fill_block(left, top + width, left + width - 1, bottom - width, color);
        self.fill_block(right - width + 1, top + width, right, bottom - width, color);
    }

    /// Draws a rectangle with rounded corners as `pygame.draw.rect` does when it is given corner radii.
    ///
    /// `width` is as in [`Canvas::draw_rect`], which also draws rectangles whose radii are all 0, and those less than 2 pixels
    /// wide or high. Radii that do not fit are scaled down. A negative width or height of `rect` extends to the left or
    /// upwards. Exact for coordinates of up to 2^16 pixels.
    pub fn draw_rounded_rect(&mut self, color: Rgb, rect: Rect, width: i32, radii: CornerRadii) {
        if width < 0 {
            return;
        }
        if radii == CornerRadii::default() || rect.width.unsigned_abs() < 2 || rect.height.unsigned_abs() < 2 {
            self.draw_rect(color, rect, width);
            return;
        }
        let bounded = |position: i32, length: i32| {
            let (start, end) = (i64::from(position), i64::from(position) + i64::from(length));
            (
                start.min(end).clamp(-MAX_COORDINATE, MAX_COORDINATE),
                start.max(end).clamp(-MAX_COORDINATE, MAX_COORDINATE) - 1,
            )
        };
        let (left, right) = bounded(rect.x, rect.width);
        let (top, bottom) = bounded(rect.y, rect.height);
        let edges = Edges { left, top, right, bottom };
        let mut width = i64::from(width);
        let (half_width, half_height) = (edges.width() / 2, edges.height() / 2);
        if width > half_width || width > half_height {
            width = half_width.max(half_height);
        }
        let corners = Corners::fitting(radii, &edges);
        if width == 0 {
            self.fill_octagon(color, &edges, &corners);
        } else {
            self.draw_sides(color, &edges, &corners, width);
        }
        for (is_left, is_top, radius) in [
            (false, true, corners.top_right),
            (true, true, corners.top_left),
            (true, false, corners.bottom_left),
            (false, false, corners.bottom_right),
        ] {
            let x = if is_left { edges.left + radius } else { edges.right - radius + 1 };
            let y = if is_top { edges.top + radius } else { edges.bottom - radius + 1 };
            self.draw_quadrant(color, (is_left, is_top), (x, y), radius, width);
        }
    }

    /// Fills a rectangle whose corners are cut off straight; the round corners are added later.
    fn fill_octagon(&mut self, color: Rgb, edges: &Edges, corners: &Corners) {
        let &Edges { left, top, right, bottom } = edges;
        let points = [
            (left, top + corners.top_left),
            (left + corners.top_left, top),
            (right - corners.top_right, top),
            (right, top + corners.top_right),
            (right, bottom - corners.bottom_right),
            (right - corners.bottom_right, bottom),
            (left + corners.bottom_left, bottom),
            (left, bottom - corners.bottom_left),
        ];
        let sides = || points.iter().zip(points.iter().cycle().skip(1));
        // A corner as high as the rectangle extends one pixel beyond it.
        let first = points.iter().fold(top, |first, point| first.min(point.1));
        let last = points.iter().fold(bottom, |last, point| last.max(point.1));

        for y in first.max(0)..=last.min(self.height() as i64 - 1) {
            // Where the slanted and upright sides cross the row; their lower ends do not count, except on the last row.
            let mut crossings: Vec<i64> = sides()
                .filter_map(|(&a, &b)| {
                    let (upper, lower) = if a.1 < b.1 { (a, b) } else { (b, a) };
                    let crosses = (upper.1 <= y && y < lower.1) || (y == last && lower.1 == last);
                    (upper.1 < lower.1 && crosses)
                        .then(|| (y - upper.1) * (lower.0 - upper.0) / (lower.1 - upper.1) + upper.0)
                })
                .collect();
            crossings.sort_unstable();
            for pair in crossings.chunks_exact(2) {
                self.fill_row(pair[0], pair[1], y, color);
            }
        }
        // The crossings do not cover a level side below which the shape narrows.
        for (a, b) in sides().filter(|(a, b)| a.1 == b.1 && first < a.1 && a.1 < last) {
            self.fill_row(a.0, b.0, a.1, color);
        }
    }

    /// Draws the straight parts of a border between its round corners.
    fn draw_sides(&mut self, color: Rgb, edges: &Edges, corners: &Corners, width: i64) {
        let &Edges { left, top, right, bottom } = edges;
        // Offsets from the middle of a side to the edges of its wide line, which covers the `width` outermost pixels.
        let (near, far) = ((width - 1) / 2, width / 2);
        for (is_level, start, end) in [
            (true, (left + corners.top_left, top + near), (right - corners.top_right, top + near)),
            (false, (left + near, top + corners.top_left), (left + near, bottom - corners.bottom_left)),
            (true, (left + corners.bottom_left, bottom - far), (right - corners.bottom_right, bottom - far)),
            (false, (right - far, top + corners.top_right), (right - far, bottom - corners.bottom_right)),
        ] {
            let (x, y) = start;
            // If two corners meet in a point, pygame only fills the gap between them.
            if start != end {
                self.stroke(color, start, end, width);
            } else if is_level {
                self.fill_block(x, y - near, x, y + far, color);
            } else {
                self.fill_block(x - near, y, x + far, y, color);
            }
        }
    }

    /// Draws a quarter of a circle, to the left or right of its centre and above or below it: filled for a `width` of 0, otherwise its
    /// border.
    fn draw_quadrant(
        &mut self,
        color: Rgb,
        (is_left, is_top): (bool, bool),
        center: (i64, i64),
        radius: i64,
        width: i64,
    ) {
        // The pixel at a distance from the centre; distances start at 1 in all directions.
        let along = |center: i64, distance: i64, is_before: bool| {
            if is_before { center - distance } else { center + distance - 1 }
        };
        let at = |x: i64, y: i64| (along(center.0, x, is_left), along(center.1, y, is_top));
        let mut fill = |(x0, y0): (i64, i64), (x1, y1): (i64, i64)| {
            self.fill_block(x0.min(x1), y0.min(y1), x0.max(x1), y0.max(y1), color);
        };
        if radius == 1 {
            fill(at(1, 1), at(1, 1));
            return;
        }
        if width == 0 {
            // Above the centre, the columns extend one pixel beyond the centre line.
            let first = if is_top { 0 } else { 1 };
            for (near, far) in Octant::new(radius) {
                fill(at(far, first), at(far, near));
                fill(at(near, first), at(near, far));
            }
            return;
        }
        // The quadrants differ in which of the two eighths owns the diagonal.
        let owns_diagonal = if is_left == is_top { Eighth::Upright } else { Eighth::Level };
        let inner_radius = radius - width;
        let mut inner = inner_radius;
        let mut thickness = width;
        for (near, far) in Octant::new(radius) {
            inner -= i64::from(midpoint_is_outside(inner_radius, near - 1, inner));
            if thickness > 1 {
                thickness = far - inner;
            }
            for eighth in [Eighth::Upright, Eighth::Level] {
                let nearest = if eighth == owns_diagonal { near } else { near + 1 };
                let start = nearest.max(far - thickness + 1);
                if start <= far {
                    match eighth {
                        Eighth::Upright => fill(at(near, start), at(near, far)),
                        Eighth::Level => fill(at(start, near), at(far, near)),
                    }
                }
            }
        }
    }
}

/// The eighth of a circle next to the vertical or to the horizontal axis.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Eighth {
    Upright,
    Level,
}
