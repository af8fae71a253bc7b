//! How the light on the ground changes from one frame to another.
//!
//! A spotlight moves by a pixel or so at a time, and only the crescents that it leaves and enters differ. Those of every small move
//! are known beforehand, pixel by pixel.

use std::ops::Range;

use smallvec::SmallVec;

use super::drawing::{Assets, Columns, Ground};
use super::rules::BAR_HEIGHT;
use super::scene::Scene;
use super::shape::Shape;
use super::spotlight::Circle;
use crate::envs::SCREEN;
use crate::raster::{Canvas, DiscColumn, Rect};

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
        // Circles keep their order.
        let mut rest = scene.circles.as_slice();
        for from in &shown.circles {
            match rest.iter().take(WINDOW).position(|to| is_moved(from, to)) {
                Some(came) => {
                    moves.extend(rest[..came].iter().map(|to| Move::Came(*to)));
                    if *from != rest[came] {
                        moves.push(Move::Moved(*from, rest[came]));
                    }
                    if scene.ground != shown.ground {
                        moves.push(Move::Came(rest[came]));
                    }
                    rest = &rest[came + 1..];
                }
                None => moves.push(Move::Left(*from)),
            }
        }
        moves.extend(rest.iter().map(|to| Move::Came(*to)));
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

    /// Paints what changes, as if there was nothing on the ground and no circle had an outline.
    pub fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        if self.moves.is_empty() {
            return;
        }
        let lit = &assets.grounds[self.scene.ground as usize];
        let black = &assets.grounds[Ground::Black as usize];
        let shaded = (self.scene.darkness < 255).then(|| lit.shaded(self.scene.darkness));
        let dark = shaded.as_ref().unwrap_or(black);
        // First what gets dark where no other circle shines, then what gets light.
        for change in &self.moves {
            match change {
                Move::Came(_) => {}
                Move::Left(circle) => {
                    for_each_run(circle, |x, rows| dark.paint_run(canvas, x, rows));
                    for other in &self.others(circle, None) {
                        for_each_run(circle, |x, rows| {
                            lit.paint_run(canvas, x, Shape::of(other.radius).disc.rows(other.centre(), x, &rows));
                        });
                    }
                }
                Move::Moved(from, to) => {
                    let others = self.others(from, Some(to));
                    if others.is_empty() {
                        paint_crescent(from, to, dark, canvas);
                    } else {
                        for_each_pixel(from, to, |x, y| {
                            let is_lit = others.iter().any(|other| other.covers((x as i32, y as i32)));
                            let ground = if is_lit { lit } else { dark };
                            *canvas.pixel_mut(x, y) = ground.pixel(x, y);
                        });
                    }
                }
            }
        }
        for change in &self.moves {
            match change {
                Move::Came(circle) => for_each_run(circle, |x, rows| lit.paint_run(canvas, x, rows)),
                Move::Left(_) => {}
                // It enters what it would leave on its way back.
                Move::Moved(from, to) => paint_crescent(to, from, lit, canvas),
            }
        }
    }

    /// The circles that may shine where `left` did, other than the one that it has become.
    #[inline]
    fn others(&self, left: &Circle, to: Option<&Circle>) -> SmallVec<[&'a Circle; 8]> {
        let bounds = left.bounds();
        let may_shine = |other: &&Circle| Some(*other) != to && other.bounds().overlaps(&bounds);
        self.scene.circles.iter().filter(may_shine).collect()
    }
}

/// Whether `to` may be the same circle as `from`, a few frames later.
#[inline]
fn is_moved(from: &Circle, to: &Circle) -> bool {
    let is_known = || Shape::of(from.radius).crescent((to.x - from.x, to.y - from.y)).is_some();
    from == to || (from.radius == to.radius && is_known())
}

/// Hands out the rows of each column that a circle covers.
#[inline]
fn for_each_run(circle: &Circle, mut paint: impl FnMut(usize, Range<usize>)) {
    let columns = Shape::of(circle.radius).disc.columns(circle.centre(), &COLUMNS, ROWS);
    columns.for_each(|DiscColumn { x, rows }| paint(x, rows));
}

/// Hands out the pixels on the screen that a circle leaves on its way.
#[inline]
fn for_each_pixel(from: &Circle, to: &Circle, mut paint: impl FnMut(usize, usize)) {
    let crescent = Shape::of(from.radius).crescent((to.x - from.x, to.y - from.y)).unwrap_or_default();
    let (x, y) = from.centre();
    for (right, down) in crescent {
        let (x, y) = ((x + i32::from(*right)) as usize, (y + i32::from(*down)) as usize);
        if COLUMNS.contains(&x) && ROWS.contains(&y) {
            paint(x, y);
        }
    }
}

/// Paints the pixels that a circle leaves on its way.
#[inline]
fn paint_crescent(from: &Circle, to: &Circle, ground: &Columns, canvas: &mut Canvas<'_>) {
    for_each_pixel(from, to, |x, y| *canvas.pixel_mut(x, y) = ground.pixel(x, y));
}
