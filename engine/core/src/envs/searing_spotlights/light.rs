//! How the light on the background changes from one frame to another.
//!
//! A spotlight moves by about a pixel per step, so that only the crescents that it leaves and enters differ. The
//! crescents of all small moves are precomputed.

use std::ops::Range;

use smallvec::SmallVec;

use super::circle::Circle;
use super::config::BAR_HEIGHT;
use super::light_spans::LightSpans;
use super::pictures::Assets;
use super::scene::Scene;
use super::shape::{Crescent, REACH, Shape};
use crate::envs::screen::{Frame, SCREEN};
use crate::raster::{Canvas, DiscColumn, Rect, copy_run};

/// Where the light is visible: below the bar.
const COLUMNS: Range<usize> = 0..SCREEN;
const ROWS: Range<usize> = BAR_HEIGHT..SCREEN;
/// The same rows, to be compared with those of circles that begin above the screen.
const SIGNED_ROWS: Range<i32> = BAR_HEIGHT as i32..SCREEN as i32;

/// Number of circles that are searched for one that has moved.
const WINDOW: usize = 3;

/// A circle that differs between two frames.
#[derive(Clone, Copy, Debug)]
enum CircleChange {
    Appeared(Circle),
    Disappeared(Circle),
    /// The circle has moved from the first position to the second, and the crescents of the move are precomputed.
    Moved(Circle, Circle),
}

/// The circles that differ between two frames of the same darkness.
#[derive(Debug)]
pub(super) struct LightChange<'a> {
    scene: &'a Scene,
    changes: SmallVec<[CircleChange; 16]>,
}

impl<'a> LightChange<'a> {
    /// The differences between a frame that shows `shown` and one that shows `scene`.
    pub fn new(shown: &Scene, scene: &'a Scene) -> Self {
        let mut changes = SmallVec::new();
        let new_background = scene.background != shown.background;
        // Circles keep their order from frame to frame.
        let mut rest = scene.circles.as_slice();
        for from in &shown.circles {
            let Some(skipped) = rest.iter().take(WINDOW).position(|to| is_moved(from, to)) else {
                changes.push(CircleChange::Disappeared(*from));
                continue;
            };
            rest[..skipped].iter().for_each(|to| changes.push(CircleChange::Appeared(*to)));
            let to = rest[skipped];
            if *from != to {
                changes.push(CircleChange::Moved(*from, to));
            }
            if new_background {
                changes.push(CircleChange::Appeared(to));
            }
            rest = &rest[skipped + 1..];
        }
        rest.iter().for_each(|to| changes.push(CircleChange::Appeared(*to)));
        LightChange { scene, changes }
    }

    /// Rectangles around everything that changes.
    #[inline]
    pub fn bounds(&self) -> impl Iterator<Item = Rect> {
        self.changes.iter().map(|change| match change {
            CircleChange::Appeared(circle) | CircleChange::Disappeared(circle) => circle.bounds(),
            CircleChange::Moved(from, to) => from.bounds().union(&to.bounds()),
        })
    }

    /// Whether anything within `rect` may change.
    #[inline]
    pub fn reaches(&self, rect: &Rect) -> bool {
        self.changes.iter().any(|change| match change {
            CircleChange::Appeared(circle) | CircleChange::Disappeared(circle) => circle.reaches(rect),
            // The diagonal of the longest precomputed move.
            CircleChange::Moved(_, to) => to.comes_within(3 * i32::from(REACH) / 2, rect),
        })
    }

    /// Paints the changes of the background, without objects and outlines.
    pub fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        if self.changes.is_empty() {
            return;
        }
        if canvas.tracks_pixels() {
            self.note_pixels(canvas);
        } else if canvas.tracks_dirty() {
            self.note_spans(canvas);
            if !canvas.has_pixels() {
                return;
            }
        }
        let frame: &mut Frame = canvas.pixels_mut().try_into().expect("the canvas is a frame");
        let lit = assets.lit.background_frame(self.scene.background);
        let dark = assets.dark(self.scene.darkness).background_frame(self.scene.background);
        // First the pixels that become dark, except within other circles, then those that become light.
        for change in &self.changes {
            match change {
                CircleChange::Appeared(_) => {}
                CircleChange::Disappeared(circle) => {
                    for_each_run(circle, |x, rows| copy_rows(x, rows, dark, frame));
                    let bounds = circle.bounds();
                    for other in self.scene.circles.iter().filter(|other| other.reaches(&bounds)) {
                        let disc = &Shape::of(other.radius).disc;
                        for_each_run(circle, |x, rows| copy_rows(x, disc.rows(other.centre(), x, &rows), lit, frame));
                    }
                }
                CircleChange::Moved(from, to) => {
                    let crescent = crescent(from, to);
                    copy_crescent(crescent, from, dark, frame);
                    let bounds = Rect { x: crescent.bounds.x + i32::from(from.x), ..crescent.bounds };
                    let bounds = Rect { y: bounds.y + i32::from(from.y), ..bounds };
                    for other in self.scene.circles.iter().filter(|other| other.reaches(&bounds) && *other != to) {
                        copy_crescent_within(crescent, from, other, lit, frame);
                    }
                }
            }
        }
        for change in &self.changes {
            match change {
                CircleChange::Appeared(circle) => for_each_run(circle, |x, rows| copy_rows(x, rows, lit, frame)),
                CircleChange::Disappeared(_) => {}
                // It enters the pixels that the opposite move would leave.
                CircleChange::Moved(from, to) => copy_crescent(crescent(to, from), to, lit, frame),
            }
        }
    }
}

impl LightChange<'_> {
    /// Marks in each column a span around the circles that have changed.
    fn note_spans(&self, canvas: &mut Canvas<'_>) {
        let mut spans = LightSpans::new();
        for change in &self.changes {
            match change {
                CircleChange::Appeared(circle) | CircleChange::Disappeared(circle) => spans.add(circle),
                CircleChange::Moved(from, to) => [from, to].into_iter().for_each(|circle| spans.add(circle)),
            }
        }
        let (firsts, ends) = spans.on_screen();
        canvas.mark_spans(&firsts, &ends);
    }

    /// Marks the pixels to be painted as dirty.
    fn note_pixels(&self, canvas: &mut Canvas<'_>) {
        for change in &self.changes {
            match change {
                CircleChange::Appeared(circle) | CircleChange::Disappeared(circle) => {
                    for_each_run(circle, |x, rows| canvas.mark_dirty(x..x + 1, &rows));
                }
                CircleChange::Moved(from, to) => {
                    for (crescent, circle) in [(crescent(from, to), from), (crescent(to, from), to)] {
                        for (x, y) in crescent.pixels.iter().filter_map(|pixel| on_screen(pixel, circle)) {
                            canvas.mark_dirty(x..x + 1, &(y..y + 1));
                        }
                    }
                }
            }
        }
    }
}

/// Whether `to` may be the same circle as `from`, a few frames later.
#[inline]
fn is_moved(from: &Circle, to: &Circle) -> bool {
    from == to || (from.radius == to.radius && Shape::is_precomputed(from.radius, (to.x - from.x, to.y - from.y)))
}

/// The pixels that a circle leaves when it moves. The caller must have checked with [`is_moved`] that they are
/// precomputed.
#[inline]
fn crescent(from: &Circle, to: &Circle) -> &'static Crescent {
    Shape::of(from.radius).crescent((to.x - from.x, to.y - from.y))
}

/// Calls `paint` with each column that a circle covers, and its rows there.
#[inline]
fn for_each_run(circle: &Circle, mut paint: impl FnMut(usize, Range<usize>)) {
    let columns = Shape::of(circle.radius).disc.columns(circle.centre(), &COLUMNS, ROWS);
    columns.for_each(|DiscColumn { x, rows }| paint(x, rows));
}

/// Copies rows of a column; an empty or reversed range copies nothing.
#[inline]
fn copy_rows(x: usize, rows: Range<usize>, from: &Frame, to: &mut Frame) {
    if rows.start < rows.end {
        let bytes = (x * SCREEN + rows.start) * 3..(x * SCREEN + rows.end) * 3;
        copy_run(&from[bytes.clone()], &mut to[bytes]);
    }
}

/// Copies a crescent of a circle.
#[inline]
fn copy_crescent(crescent: &Crescent, circle: &Circle, from: &Frame, to: &mut Frame) {
    let bounds = circle.bounds();
    if circle.has_all_rows() {
        crescent.copy((bounds.x, bounds.y), from, to);
    } else {
        crescent.copy_rows((bounds.x, bounds.y), &SIGNED_ROWS, from, to);
    }
}

/// Copies the part of a circle's crescent that lies in another circle.
#[inline]
fn copy_crescent_within(crescent: &Crescent, circle: &Circle, other: &Circle, from: &Frame, to: &mut Frame) {
    let (bounds, disc) = (circle.bounds(), &Shape::of(other.radius).disc);
    crescent.copy_within((bounds.x, bounds.y), (disc, other.centre()), &SIGNED_ROWS, from, to);
}

/// The pixel at an offset from a circle's centre, if the light is visible there.
#[inline]
fn on_screen((right, down): &(i8, i8), circle: &Circle) -> Option<(usize, usize)> {
    let (x, y) = (i32::from(circle.x) + i32::from(*right), i32::from(circle.y) + i32::from(*down));
    let (x, y) = (x as usize, y as usize);
    (COLUMNS.contains(&x) && ROWS.contains(&y)).then_some((x, y))
}
