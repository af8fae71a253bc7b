//! Straight lines, thin and wide.

use super::canvas::Canvas;
use super::runs::Rgb;

/// A point in whole pixels.
type Point = (i64, i64);

/// Bresenham's algorithm, with pygame's error term.
struct Walk {
    span: Point,
    step: Point,
    error: i64,
}

impl Walk {
    fn new(start: Point, end: Point) -> Self {
        let span = ((end.0 - start.0).abs(), (end.1 - start.1).abs());
        let step = (if start.0 < end.0 { 1 } else { -1 }, if start.1 < end.1 { 1 } else { -1 });
        let error = if span.0 > span.1 { span.0 } else { -span.1 } / 2;
        Self { span, step, error }
    }

    /// The step to the next point: -1, 0 or 1 along each axis.
    fn next(&mut self) -> Point {
        let error = self.error;
        let mut step = (0, 0);
        if error > -self.span.0 {
            self.error -= self.span.1;
            step.0 = self.step.0;
        }
        if error < self.span.1 {
            self.error += self.span.0;
            step.1 = self.step.1;
        }
        step
    }

    /// Whether `point` has reached or passed `end` along both axes.
    fn has_passed(&self, point: Point, end: Point) -> bool {
        (point.0 - end.0) * self.step.0 >= 0 && (point.1 - end.1) * self.step.1 >= 0
    }
}

/// Clips a line to `0..=width` and `0..=height` by Liang and Barsky's method; `None` if nothing is left. As in pygame, the far
/// edges are one pixel too far out, and the ends are rounded.
fn clip_line(start: Point, end: Point, width: i64, height: i64) -> Option<(Point, Point)> {
    let delta = (end.0 - start.0, end.1 - start.1);
    let mut enter = 0.0f64;
    let mut leave = 1.0f64;
    for (delta, start, size) in [(delta.0, start.0, width), (delta.1, start.1, height)] {
        if delta == 0 {
            if start < 0 || start > size {
                return None;
            }
            continue;
        }
        let low = -start as f64 / delta as f64;
        let high = (size - start) as f64 / delta as f64;
        enter = enter.max(low.min(high));
        leave = leave.min(low.max(high));
    }
    if enter > leave {
        return None;
    }
    let at = |part: f64| {
        let along = |start: i64, delta: i64| {
            let distance = delta as f64 * part;
            start + (distance + if distance < 0.0 { -0.5 } else { 0.5 }) as i64
        };
        (along(start.0, delta.0), along(start.1, delta.1))
    };
    Some((at(enter), at(leave)))
}

impl Canvas<'_> {
    /// Draws a line of `width` pixels between two points, both included, as `pygame.draw.line` does: the ends of a wide line
    /// are flat, and its width is measured along the axis in which the line is shorter. Nothing is drawn for a `width` below 1.
    ///
    /// pygame truncates the points towards zero first.
    pub fn draw_line(&mut self, color: Rgb, start: (i32, i32), end: (i32, i32), width: i32) {
        let start = (start.0.into(), start.1.into());
        let end = (end.0.into(), end.1.into());
        if width >= 1 {
            self.stroke(color, start, end, width.into());
        }
    }

    /// Draws a line with a `width` of at least 1.
    pub(super) fn stroke(&mut self, color: Rgb, start: Point, end: Point, width: i64) {
        let size = (self.width() as i64, self.height() as i64);
        let Some(clipped) = clip_line(start, end, size.0, size.1) else {
            return;
        };
        if width == 1 {
            self.stroke_thin(color, clipped.0, clipped.1);
        } else {
            self.stroke_wide(color, start, end, clipped, width);
        }
    }

    fn stroke_thin(&mut self, color: Rgb, start: Point, end: Point) {
        let mut walk = Walk::new(start, end);
        let mut point = start;
        while point != end {
            self.put(point.0, point.1, color);
            let step = walk.next();
            point = (point.0 + step.0, point.1 + step.1);
        }
        self.put(end.0, end.1, color);
    }

    /// Walks from the first `clipped` point to the second, and on towards the unclipped `end` while an edge of the line is
    /// visible.
    fn stroke_wide(&mut self, color: Rgb, start: Point, end: Point, clipped: (Point, Point), width: i64) {
        // From here on, the first coordinate runs along the line, the second across it.
        let is_steep = (end.0 - start.0).abs() <= (end.1 - start.1).abs();
        let turned = |(x, y): Point| if is_steep { (y, x) } else { (x, y) };
        let size = turned((self.width() as i64, self.height() as i64));
        let end = turned(end);
        let clipped_end = turned(clipped.1);
        let mut walk = Walk::new(turned(start), end);
        let (mut along, mut across) = turned(clipped.0);
        loop {
            // Beyond the canvas and moving away from it: nothing is left to paint.
            if if walk.step.0 > 0 { along >= size.0 } else { along < 0 } {
                return;
            }
            let (low, high) = (across - (width - 1) / 2, across + width / 2);
            let ((x0, y0), (x1, y1)) = (turned((along, low)), turned((along, high)));
            self.fill_block(x0, y0, x1, y1, color);

            let shows = |edge| (0..size.0).contains(&along) && (0..size.1).contains(&edge);
            let is_visible = shows(low) || shows(high);
            if walk.has_passed((along, across), clipped_end) && (along == end.0 || !is_visible) {
                return;
            }
            let step = walk.next();
            along += step.0;
            across += step.1;
        }
    }
}
