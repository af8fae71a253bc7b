//! How the light on the ground changes from one frame to another.
//!
//! A spotlight moves by a pixel or so at a time, and only the crescents that it leaves and enters differ. Those of every small move
//! are known beforehand.

use std::ops::Range;

use smallvec::SmallVec;

use super::drawing::{Assets, Frame};
use super::rules::BAR_HEIGHT;
use super::scene::Scene;
use super::shape::{Crescent, REACH, Shape};
use super::spotlight::Circle;
use crate::envs::SCREEN;
use crate::raster::{Canvas, DiscColumn, Rect, copy_run};

/// Where the light can be seen: the bar covers what is above.
const COLUMNS: Range<usize> = 0..SCREEN;
const ROWS: Range<usize> = BAR_HEIGHT..SCREEN;

/// How many circles may have come in between.
const WINDOW: usize = 3;

/// A circle that differs between two frames.
#[derive(Clone, Copy, Debug)]
enum Move {
    Came(Circle),
    Left(Circle),
    /// It is the same circle but for its place, and the crescents of the move are known.
    Moved(Circle, Circle),
}

/// The circles that differ between two frames which are equally dark.
#[derive(Debug)]
pub(super) struct Change<'a> {
    scene: &'a Scene,
    moves: SmallVec<[Move; 16]>,
}

impl<'a> Change<'a> {
    /// What changes a frame that shows `shown` into one that shows `scene`.
    pub fn new(shown: &Scene, scene: &'a Scene) -> Self {
        let mut moves = SmallVec::new();
        let new_ground = scene.ground != shown.ground;
        // Circles keep their order.
        let mut rest = scene.circles.as_slice();
        for from in &shown.circles {
            let Some(came) = rest.iter().take(WINDOW).position(|to| is_moved(from, to)) else {
                moves.push(Move::Left(*from));
                continue;
            };
            rest[..came].iter().for_each(|to| moves.push(Move::Came(*to)));
            let to = rest[came];
            if *from != to {
                moves.push(Move::Moved(*from, to));
            }
            if new_ground {
                moves.push(Move::Came(to));
            }
            rest = &rest[came + 1..];
        }
        rest.iter().for_each(|to| moves.push(Move::Came(*to)));
        Change { scene, moves }
    }

    /// Rectangles about all that changes.
    #[inline]
    pub fn bounds(&self) -> impl Iterator<Item = Rect> {
        self.moves.iter().map(|change| match change {
            Move::Came(circle) | Move::Left(circle) => circle.bounds(),
            Move::Moved(from, to) => from.bounds().union(&to.bounds()),
        })
    }

    /// Whether anything within `rect` may change.
    #[inline]
    pub fn reaches(&self, rect: &Rect) -> bool {
        self.moves.iter().any(|change| match change {
            Move::Came(circle) | Move::Left(circle) => circle.reaches(rect),
            // Along the diagonal of the longest known move.
            Move::Moved(_, to) => to.comes_within(3 * i32::from(REACH) / 2, rect),
        })
    }

    /// Paints what changes, as if there was nothing on the ground and no circle had an outline.
    pub fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        if self.moves.is_empty() {
            return;
        }
        if canvas.tracks_dirty() {
            self.note(canvas);
        }
        let frame: &mut Frame = canvas.pixels_mut().try_into().expect("the canvas is a frame");
        let lit = assets.lit.picture(self.scene.ground);
        let dark = assets.dark(self.scene.darkness).picture(self.scene.ground);
        // First what gets dark where no other circle shines, then what gets light.
        for change in &self.moves {
            match change {
                Move::Came(_) => {}
                Move::Left(circle) => {
                    for_each_run(circle, |x, rows| copy_rows(x, rows, dark, frame));
                    let bounds = circle.bounds();
                    for other in self.scene.circles.iter().filter(|other| other.reaches(&bounds)) {
                        let disc = &Shape::of(other.radius).disc;
                        for_each_run(circle, |x, rows| copy_rows(x, disc.rows(other.centre(), x, &rows), lit, frame));
                    }
                }
                Move::Moved(from, to) => {
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
        for change in &self.moves {
            match change {
                Move::Came(circle) => for_each_run(circle, |x, rows| copy_rows(x, rows, lit, frame)),
                Move::Left(_) => {}
                // It enters what it would leave on its way back.
                Move::Moved(from, to) => copy_crescent(crescent(to, from), to, lit, frame),
            }
        }
    }
}

impl Change<'_> {
    /// Notes the pixels that are painted.
    fn note(&self, canvas: &mut Canvas<'_>) {
        for change in &self.moves {
            match change {
                Move::Came(circle) | Move::Left(circle) => {
                    for_each_run(circle, |x, rows| canvas.mark_dirty(x..x + 1, &rows))
                }
                Move::Moved(from, to) => {
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
    from == to || (from.radius == to.radius && Shape::is_known(from.radius, (to.x - from.x, to.y - from.y)))
}

/// What a circle leaves on its way; [`is_moved`] has told that it is known.
#[inline]
fn crescent(from: &Circle, to: &Circle) -> &'static Crescent {
    Shape::of(from.radius).crescent((to.x - from.x, to.y - from.y))
}

/// Hands out the rows of each column that a circle covers.
#[inline]
fn for_each_run(circle: &Circle, mut paint: impl FnMut(usize, Range<usize>)) {
    let columns = Shape::of(circle.radius).disc.columns(circle.centre(), &COLUMNS, ROWS);
    columns.for_each(|DiscColumn { x, rows }| paint(x, rows));
}

/// Copies some rows of a column, as far as there are any.
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
    if circle.has_all_rows() {
        let bounds = circle.bounds();
        crescent.copy((bounds.x, bounds.y), from, to);
    } else {
        for pixel in &crescent.pixels {
            copy_pixel(pixel, circle, from, to);
        }
    }
}

/// Copies the part of a circle's crescent that lies in another circle.
#[inline]
fn copy_crescent_within(crescent: &Crescent, circle: &Circle, other: &Circle, from: &Frame, to: &mut Frame) {
    let disc = &Shape::of(other.radius).disc;
    let (x, y) = (i32::from(circle.x - other.x), i32::from(circle.y - other.y));
    for pixel in &crescent.pixels {
        if disc.contains((x + i32::from(pixel.0), y + i32::from(pixel.1))) {
            copy_pixel(pixel, circle, from, to);
        }
    }
}

/// Copies a pixel at a place from a circle's centre, if it is on the screen.
#[inline]
fn copy_pixel(pixel: &(i8, i8), circle: &Circle, from: &Frame, to: &mut Frame) {
    if let Some((x, y)) = on_screen(pixel, circle) {
        let byte = (x * SCREEN + y) * 3;
        to[byte..byte + 3].copy_from_slice(&from[byte..byte + 3]);
    }
}

/// The pixel at a place from a circle's centre, if it is where light can be seen.
#[inline]
fn on_screen((right, down): &(i8, i8), circle: &Circle) -> Option<(usize, usize)> {
    let (x, y) = (i32::from(circle.x) + i32::from(*right), i32::from(circle.y) + i32::from(*down));
    let (x, y) = (x as usize, y as usize);
    (COLUMNS.contains(&x) && ROWS.contains(&y)).then_some((x, y))
}
