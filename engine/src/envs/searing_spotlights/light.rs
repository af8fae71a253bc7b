//! How the light on the ground changes from one frame to another.
//!
//! A spotlight moves by a pixel or so at a time, and only the crescents that it leaves and enters differ. Both are found column
//! by column, as the difference of two runs of pixels.

use std::ops::Range;

use smallvec::SmallVec;

use super::drawing::{Assets, Columns};
use super::rules::BAR_HEIGHT;
use super::scene::Scene;
use super::spotlight::Circle;
use crate::envs::SCREEN;
use crate::raster::{Canvas, Disc, DiscColumn, Rect};

/// Where the light can be seen: the bar covers what is above.
const COLUMNS: Range<usize> = 0..SCREEN;
const ROWS: Range<usize> = BAR_HEIGHT..SCREEN;

/// How far a circle goes at most that is taken for the same in two frames, in pixels along each axis.
const REACH: u16 = 4;

/// How many circles may have come in between.
const WINDOW: usize = 3;

/// A circle before and after. One that came or went has no counterpart, nor has one that went far.
#[derive(Clone, Copy, Debug)]
struct Move {
    from: Option<Circle>,
    to: Option<Circle>,
}

/// The circles that differ between two frames which are equally dark, and that have no outlines.
#[derive(Debug)]
pub(super) struct Change<'a> {
    scene: &'a Scene,
    moves: SmallVec<[Move; 12]>,
    /// The ground has changed in all circles.
    relaid: bool,
}

impl<'a> Change<'a> {
    /// What changes a frame that shows `shown` into one that shows `scene`.
    pub fn new(shown: &Scene, scene: &'a Scene) -> Self {
        let relaid = scene.ground != shown.ground;
        let mut moves = SmallVec::new();
        let mut add = |from: Option<Circle>, to: Option<Circle>| {
            if from != to || relaid {
                moves.push(Move { from, to });
            }
        };
        // Circles keep their order.
        let mut rest = scene.circles.as_slice();
        for from in &shown.circles {
            let counterpart = rest.iter().take(WINDOW).position(|to| is_near(from, to));
            let (came, from_here) = rest.split_at(counterpart.unwrap_or(0));
            came.iter().for_each(|to| add(None, Some(*to)));
            add(Some(*from), counterpart.map(|_| from_here[0]));
            rest = &from_here[usize::from(counterpart.is_some())..];
        }
        rest.iter().for_each(|to| add(None, Some(*to)));
        Change { scene, moves, relaid }
    }

    /// Rectangles about all that changes.
    pub fn bounds(&self) -> impl Iterator<Item = Rect> {
        self.moves.iter().flat_map(|change| [change.from, change.to]).flatten().map(|circle| circle.bounds())
    }

    /// Whether anything within `rect` may change.
    pub fn touches(&self, rect: &Rect) -> bool {
        self.bounds().any(|bounds| bounds.overlaps(rect))
    }

    /// Paints what changes, as if there was nothing on the ground.
    pub fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        let lit = &assets.grounds[self.scene.ground as usize];
        let dark = lit.shaded(self.scene.darkness);
        for Move { from, to } in &self.moves {
            if let Some(from) = from {
                self.leave(from, to.as_ref(), lit, &dark, assets, canvas);
            }
        }
        for Move { from, to } in &self.moves {
            let Some(to) = to else { continue };
            // What was lit before is lit still.
            let from = from.filter(|_| !self.relaid);
            assets.with_shape(to, |shape| {
                for DiscColumn { x, rows } in shape.disc.columns(to.centre(), &COLUMNS, ROWS) {
                    let before = run(from.as_ref(), &shape.disc, x);
                    outside(rows, before).into_iter().for_each(|rows| lit.paint_run(canvas, x, rows));
                }
            });
        }
    }

    /// Darkens what `from` lit and `to` does not, except where another circle does.
    fn leave(
        &self,
        from: &Circle,
        to: Option<&Circle>,
        lit: &Columns,
        dark: &Columns,
        assets: &Assets,
        canvas: &mut Canvas<'_>,
    ) {
        let bounds = from.bounds();
        let others: SmallVec<[&Circle; 8]> =
            self.scene.circles.iter().filter(|other| Some(*other) != to && other.bounds().overlaps(&bounds)).collect();
        assets.with_shape(from, |shape| {
            for DiscColumn { x, rows } in shape.disc.columns(from.centre(), &COLUMNS, ROWS) {
                for left in outside(rows, run(to, &shape.disc, x)).into_iter().filter(|left| left.start < left.end) {
                    dark.paint_run(canvas, x, left.clone());
                    for other in &others {
                        assets.with_shape(other, |shape| {
                            lit.paint_run(canvas, x, shape.disc.rows(other.centre(), x, &left));
                        });
                    }
                }
            }
        });
    }
}

/// Whether two circles may be the same one in two frames.
fn is_near(from: &Circle, to: &Circle) -> bool {
    from.radius == to.radius && from.x.abs_diff(to.x) <= REACH && from.y.abs_diff(to.y) <= REACH
}

/// The rows of a column that a circle covers.
#[inline]
fn run(circle: Option<&Circle>, disc: &Disc, x: usize) -> Range<usize> {
    circle.map_or(0..0, |circle| disc.rows(circle.centre(), x, &ROWS))
}

/// The parts of a run outside of another: above it and below it. Either may be empty.
#[inline]
fn outside(run: Range<usize>, other: Range<usize>) -> [Range<usize>; 2] {
    [run.start..run.end.min(other.start), run.start.max(other.end)..run.end]
}
