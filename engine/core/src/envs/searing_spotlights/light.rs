//! How the light on the background changes from one frame to another.
//!
//! A spotlight moves by about a pixel per step, so that only the crescents that it leaves and enters differ. The
//! crescents of all small moves are precomputed.

use std::ops::Range;

use smallvec::SmallVec;

use super::circle::Circle;
use super::circles::{Circles, Numbers};
use super::config::BAR_HEIGHT;
use super::crescents::{Crescents, REACH};
use super::extent::Extent;
use super::light_spans::LightSpans;
use super::pictures::Assets;
use super::scene::Scene;
use super::shape::Shape;
use crate::envs::screen::{Frame, SCREEN};
use crate::raster::{Canvas, DiscColumn, Rect, copy_run};

/// Where the light is visible: below the bar.
const COLUMNS: Range<usize> = 0..SCREEN;

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

/// The circles that differ between two frames of the same darkness.
#[derive(Debug)]
pub(super) struct LightChange<'a> {
    scene: &'a Scene,
    shown: &'a Scene,
    /// The circles of the scene that have moved, and the crescents of the move are precomputed.
    moved: Numbers,
    /// For each of them, its number in the scene that was shown.
    former: [u8; Circles::MAX_NUMBERED],
    replaced: SmallVec<[Replaced; 8]>,
}

impl<'a> LightChange<'a> {
    /// The differences between a frame that shows `shown` and one that shows `scene`, with at most [`Circles::MAX_NUMBERED`] circles
    /// each.
    #[inline(always)]
    pub fn new(shown: &'a Scene, scene: &'a Scene) -> Self {
        // Without a circle that has appeared or disappeared, the numbers are the same.
        let former = std::array::from_fn(|number| number as u8);
        let mut change = LightChange { scene, shown, moved: Numbers::NONE, former, replaced: SmallVec::new() };
        match scene.circles.moved_since(&shown.circles) {
            Some(moved) if scene.background == shown.background => change.moved = moved,
            _ => change.search(),
        }
        change
    }

    /// Finds the circles that have moved where others have appeared or disappeared.
    #[inline(never)]
    fn search(&mut self) {
        let new_background = self.scene.background != self.shown.background;
        let (circles, mut number) = (&self.scene.circles, 0);
        // Circles keep their order from frame to frame.
        for (former, from) in self.shown.circles.iter().enumerate() {
            let mut window = number..circles.len().min(number + WINDOW);
            let Some(found) = window.find(|to| is_moved(&from, &circles.get(*to))) else {
                self.replaced.push(Replaced::Disappeared(from));
                continue;
            };
            self.replaced.extend((number..found).map(|to| Replaced::Appeared(circles.get(to))));
            let to = circles.get(found);
            self.former[found] = former as u8;
            self.moved.set(found, (from.x, from.y) != (to.x, to.y));
            if new_background {
                self.replaced.push(Replaced::Appeared(to));
            }
            number = found + 1;
        }
        self.replaced.extend((number..circles.len()).map(|to| Replaced::Appeared(circles.get(to))));
    }

    /// The circles that have moved, before and after.
    #[inline(always)]
    fn moved(&self) -> impl Iterator<Item = (usize, Circle, Circle)> {
        let former = |number: usize| self.shown.circles.get(self.former[number].into());
        self.moved.map(move |number| (number, former(number), self.scene.circles.get(number)))
    }

    /// The circles that may light what the circle of that number leaves; `None` without any.
    #[inline(always)]
    fn others(
        &self,
        number: usize,
        from: &Circle,
        crescents: &Crescents,
    ) -> Option<impl Iterator<Item = (Circle, &'static Extent)> + Clone> {
        let numbers = self.scene.circles.reaching(crescents.bounds_of_left(from)).without(number);
        let others = numbers.map(|other| {
            let other = self.scene.circles.get(other);
            (other, &Shape::of(other.radius).extent)
        });
        (!numbers.is_empty()).then_some(others)
    }

    /// Rectangles around everything that changes.
    #[inline(always)]
    pub fn bounds(&self) -> impl Iterator<Item = Rect> {
        let moved = self.moved().map(|(_, from, to)| from.bounds().union(&to.bounds()));
        self.replaced.iter().map(|replaced| replaced.circle().bounds()).chain(moved)
    }

    /// Whether anything within `rect` may change.
    #[inline(always)]
    pub fn reaches(&self, rect: &Rect) -> bool {
        // A circle that reached the rectangle before its move is now at most that far away.
        let reach = i32::from(REACH);
        let near = Rect::new(rect.x - reach, rect.y - reach, rect.width + 2 * reach, rect.height + 2 * reach);
        !self.moved.and(self.scene.circles.reaching(&near)).is_empty()
            || self.replaced.iter().any(|replaced| replaced.circle().reaches(rect))
    }

    /// Paints the changes of the background, without objects and outlines.
    #[inline(always)]
    pub fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        if self.moved.is_empty() && self.replaced.is_empty() {
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
        // Nothing that a circle of the scene lights is dark in the end, so that the order of the changes does not matter.
        for (number, from, to) in self.moved() {
            let crescents = crescents(&from, &to);
            crescents.paint(&from, self.others(number, &from, crescents), [dark, lit], frame);
        }
        for replaced in &self.replaced {
            match replaced {
                Replaced::Appeared(circle) => for_each_run(circle, |x, rows| copy_rows(x, rows, lit, frame)),
                Replaced::Disappeared(circle) => {
                    for_each_run(circle, |x, rows| copy_rows(x, rows, dark, frame));
                    for other in self.scene.circles.reaching(&circle.bounds()) {
                        let other = self.scene.circles.get(other);
                        let disc = &Shape::of(other.radius).extent.disc;
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
        self.moved().for_each(|(_, from, to)| [from, to].iter().for_each(|circle| spans.add(circle)));
        let (firsts, ends) = spans.on_screen();
        canvas.mark_spans(&firsts, &ends);
    }

    /// Marks the pixels to be painted as dirty.
    fn note_pixels(&self, canvas: &mut Canvas<'_>) {
        for replaced in &self.replaced {
            for_each_run(replaced.circle(), |x, rows| canvas.mark_dirty(x..x + 1, &rows));
        }
        for (number, from, to) in self.moved() {
            let crescents = crescents(&from, &to);
            let painted = crescents.painted(&from, self.others(number, &from, crescents));
            painted.for_each(|(x, y)| canvas.mark_dirty(x..x + 1, &(y..y + 1)));
        }
    }
}

/// Whether `to` may be the same circle as `from`, a few frames later.
#[inline(always)]
fn is_moved(from: &Circle, to: &Circle) -> bool {
    let (x, y) = (to.x - from.x, to.y - from.y);
    (from.radius == to.radius) & (Shape::is_precomputed(from.radius, (x, y)) | (x | y == 0))
}

/// The pixels that change when a circle moves. The caller must have checked with [`is_moved`] that they are precomputed.
#[inline(always)]
fn crescents(from: &Circle, to: &Circle) -> &'static Crescents {
    Shape::of(from.radius).crescents((to.x - from.x, to.y - from.y))
}

/// Calls `paint` with each column that a circle covers, and its rows there.
#[inline(always)]
fn for_each_run(circle: &Circle, mut paint: impl FnMut(usize, Range<usize>)) {
    let columns = Shape::of(circle.radius).extent.disc.columns(circle.centre(), &COLUMNS, BAR_HEIGHT..SCREEN);
    columns.for_each(|DiscColumn { x, rows }| paint(x, rows));
}

/// Copies rows of a column; an empty or reversed range copies nothing.
#[inline(always)]
fn copy_rows(x: usize, rows: Range<usize>, from: &Frame, to: &mut Frame) {
    if rows.start < rows.end {
        let bytes = (x * SCREEN + rows.start) * 3..(x * SCREEN + rows.end) * 3;
        copy_run(&from[bytes.clone()], &mut to[bytes]);
    }
}
