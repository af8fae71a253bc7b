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
const ROWS: Range<i32> = BAR_HEIGHT as i32..SCREEN as i32;

/// The most circles of a frame whose changes are searched; with more, the whole frame is painted.
pub(super) const MANY: usize = 32;

/// Number of circles that are searched for one that has moved.
const WINDOW: usize = 3;

/// A circle that is not the same in two frames, and has not moved by a precomputed move.
#[derive(Clone, Copy, Debug)]
enum Replaced {
    Appeared(Circle),
    Disappeared(Circle),
}

impl Replaced {
    fn circle(&self) -> &Circle {
        match self {
            Replaced::Appeared(circle) | Replaced::Disappeared(circle) => circle,
        }
    }
}

/// A circle that has moved, and the crescents of the move are precomputed.
#[derive(Clone, Copy, Debug, Default)]
struct Moved {
    from: Circle,
    to: Circle,
    /// Its number among the circles of the scene.
    number: u8,
}

/// The circles that differ between two frames of the same darkness.
#[derive(Debug)]
pub(super) struct LightChange<'a> {
    scene: &'a Scene,
    moved: [Moved; MANY],
    num_moved: usize,
    replaced: SmallVec<[Replaced; 8]>,
}

impl<'a> LightChange<'a> {
    /// The differences between a frame that shows `shown` and one that shows `scene`, with at most [`MANY`] circles each.
    pub fn new(shown: &Scene, scene: &'a Scene) -> Self {
        let (mut moved, mut num_moved, mut replaced) = ([Moved::default(); MANY], 0, SmallVec::new());
        let new_background = scene.background != shown.background;
        // Circles keep their order from frame to frame.
        let (circles, mut number) = (scene.circles.as_slice(), 0);
        for from in shown.circles.as_slice() {
            let Some(skipped) = circles[number..].iter().take(WINDOW).position(|to| is_moved(from, to)) else {
                replaced.push(Replaced::Disappeared(*from));
                continue;
            };
            if skipped > 0 {
                replaced.extend(circles[number..][..skipped].iter().map(|to| Replaced::Appeared(*to)));
                number += skipped;
            }
            let to = circles[number];
            // Written in any case: no processor predicts which circles have moved to another pixel.
            moved[num_moved] = Moved { from: *from, to, number: number as u8 };
            num_moved += usize::from((from.x != to.x) | (from.y != to.y));
            if new_background {
                replaced.push(Replaced::Appeared(to));
            }
            number += 1;
        }
        if number < circles.len() {
            replaced.extend(circles[number..].iter().map(|to| Replaced::Appeared(*to)));
        }
        LightChange { scene, moved, num_moved, replaced }
    }

    fn moved(&self) -> &[Moved] {
        &self.moved[..self.num_moved]
    }

    /// Rectangles around everything that changes.
    #[inline]
    pub fn bounds(&self) -> impl Iterator<Item = Rect> {
        let moved = self.moved().iter().map(|moved| moved.from.bounds().union(&moved.to.bounds()));
        self.replaced.iter().map(|replaced| replaced.circle().bounds()).chain(moved)
    }

    /// Whether anything within `rect` may change.
    #[inline]
    pub fn reaches(&self, rect: &Rect) -> bool {
        // The diagonal of the longest precomputed move.
        let near = |moved: &Moved| moved.to.comes_within(3 * i32::from(REACH) / 2, rect);
        // All of them without a branch, since most are far away.
        self.moved().iter().fold(false, |reached, moved| reached | near(moved))
            || self.replaced.iter().any(|replaced| replaced.circle().reaches(rect))
    }

    /// Paints the changes of the background, without objects and outlines.
    pub fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        if self.num_moved == 0 && self.replaced.is_empty() {
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
        let circles = self.scene.circles.as_slice();
        // What becomes dark is lit again within the circles of the scene, so that the order of the changes does not matter.
        for Moved { from, to, number } in self.moved() {
            let (left, entered) = crescents(from, to);
            left.copy(corner(from), &ROWS, dark, frame);
            let bounds = Rect { x: left.bounds.x + i32::from(from.x), ..left.bounds };
            let bounds = Rect { y: bounds.y + i32::from(from.y), ..bounds };
            for (other, circle) in circles.iter().enumerate() {
                if (other != usize::from(*number)) & circle.reaches(&bounds) {
                    let disc = &Shape::of(circle.radius).disc;
                    left.copy_within(corner(from), (disc, circle.centre()), &ROWS, lit, frame);
                }
            }
            entered.copy(corner(to), &ROWS, lit, frame);
        }
        for replaced in &self.replaced {
            match replaced {
                Replaced::Appeared(circle) => for_each_run(circle, |x, rows| copy_rows(x, rows, lit, frame)),
                Replaced::Disappeared(circle) => {
                    for_each_run(circle, |x, rows| copy_rows(x, rows, dark, frame));
                    let bounds = circle.bounds();
                    for other in circles.iter().filter(|other| other.reaches(&bounds)) {
                        let disc = &Shape::of(other.radius).disc;
                        for_each_run(circle, |x, rows| copy_rows(x, disc.rows(other.centre(), x, &rows), lit, frame));
                    }
                }
            }
        }
    }
}

impl LightChange<'_> {
    /// Marks in each column a span around the circles that have changed.
    fn note_spans(&self, canvas: &mut Canvas<'_>) {
        let mut spans = LightSpans::new();
        self.replaced.iter().for_each(|replaced| spans.add(replaced.circle()));
        self.moved().iter().for_each(|moved| [moved.from, moved.to].iter().for_each(|circle| spans.add(circle)));
        let (firsts, ends) = spans.on_screen();
        canvas.mark_spans(&firsts, &ends);
    }

    /// Marks the pixels to be painted as dirty.
    fn note_pixels(&self, canvas: &mut Canvas<'_>) {
        for replaced in &self.replaced {
            for_each_run(replaced.circle(), |x, rows| canvas.mark_dirty(x..x + 1, &rows));
        }
        for Moved { from, to, .. } in self.moved() {
            let (left, entered) = crescents(from, to);
            for (crescent, circle) in [(left, from), (entered, to)] {
                for (x, y) in crescent.pixels.iter().filter_map(|pixel| on_screen(pixel, circle)) {
                    canvas.mark_dirty(x..x + 1, &(y..y + 1));
                }
            }
        }
    }
}

/// Whether `to` may be the same circle as `from`, a few frames later.
#[inline]
fn is_moved(from: &Circle, to: &Circle) -> bool {
    let (x, y) = (to.x - from.x, to.y - from.y);
    (from.radius == to.radius) & (Shape::is_precomputed(from.radius, (x, y)) | (x | y == 0))
}

/// The pixels that a circle leaves when it moves, and those that it enters, which are those that the opposite move would leave. The
/// caller must have checked with [`is_moved`] that they are precomputed.
#[inline]
fn crescents(from: &Circle, to: &Circle) -> (&'static Crescent, &'static Crescent) {
    let (shape, x, y) = (Shape::of(from.radius), to.x - from.x, to.y - from.y);
    (shape.crescent((x, y)), shape.crescent((-x, -y)))
}

/// The corner of a circle's bounds.
#[inline]
fn corner(circle: &Circle) -> (i32, i32) {
    let Rect { x, y, .. } = circle.bounds();
    (x, y)
}

/// Calls `paint` with each column that a circle covers, and its rows there.
#[inline]
fn for_each_run(circle: &Circle, mut paint: impl FnMut(usize, Range<usize>)) {
    let columns = Shape::of(circle.radius).disc.columns(circle.centre(), &COLUMNS, BAR_HEIGHT..SCREEN);
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

/// The pixel at an offset from a circle's centre, if the light is visible there.
#[inline]
fn on_screen((right, down): &(i8, i8), circle: &Circle) -> Option<(usize, usize)> {
    let (x, y) = (i32::from(circle.x) + i32::from(*right), i32::from(circle.y) + i32::from(*down));
    let (x, y) = (x as usize, y as usize);
    (COLUMNS.contains(&x) && (BAR_HEIGHT..SCREEN).contains(&y)).then_some((x, y))
}
