//! Changes of the light on the background from one frame to another.
//!
//! A spotlight moves by about a pixel per step, so only the crescents that it leaves and enters differ. The crescents of short
//! moves are precomputed.

use std::ops::Range;
use std::sync::OnceLock;

use smallvec::SmallVec;

use super::circles::{Circle, Circles, Edges, MAX_MOVED_RADIUS, Numbers, REACH, is_short_move};
use super::config::BAR_HEIGHT;
use super::parameters::MAX_SPOT_RADIUS;
use super::scene::Scene;
use crate::screen::{Frame, SCREEN};
use endless_gym_core::raster::{Canvas, Disc, DiscColumn, Rect, Rgb, circle_outline, copy_run};

/// The pixels of a background, column by column.
pub(super) type Pixels = [[Rgb; SCREEN]; SCREEN];

/// Number of circles among which to search for one that has moved.
const WINDOW: usize = 3;

/// A circle that differs between two frames, other than by a precomputed move.
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
    /// The circles of the scene that have moved, by precomputed moves.
    moved: Numbers,
    /// For each moved circle, its number in the scene that was shown.
    former: [u8; Circles::MAX_NUMBERED],
    replaced: SmallVec<[Replaced; 8]>,
}

impl<'a> LightChange<'a> {
    /// The differences between frames that show `shown` and `scene`, with at most [`Circles::MAX_NUMBERED`] circles each.
    #[inline]
    pub fn new(shown: &'a Scene, scene: &'a Scene) -> Self {
        // If no circle has appeared or disappeared, the numbers are the same.
        let former = std::array::from_fn(|number| number as u8);
        let mut change = LightChange { scene, shown, moved: Numbers::NONE, former, replaced: SmallVec::new() };
        match scene.circles.moved_since(&shown.circles) {
            Some(moved) if scene.background == shown.background => change.moved = moved,
            _ => change.search(),
        }
        change
    }

    /// Finds the circles that have moved when others have appeared or disappeared.
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
    #[inline]
    fn moved(&self) -> impl Iterator<Item = (usize, Circle, Circle)> {
        let former = |number: usize| self.shown.circles.get(self.former[number].into());
        self.moved.map(move |number| (number, former(number), self.scene.circles.get(number)))
    }

    /// The circles that may light what circle number `number` leaves.
    #[inline]
    fn others(&self, number: usize, from: &Circle, crescents: &Crescents) -> impl Iterator<Item = Circle> + Clone {
        let numbers = self.scene.circles.reaching(crescents.bounds_of_left(from)).without(number);
        numbers.map(|other| self.scene.circles.get(other))
    }

    /// Rectangles around everything that changes.
    #[inline]
    pub fn bounds(&self) -> impl Iterator<Item = Rect> {
        let moved = self.moved().map(|(_, from, to)| from.bounds().union(&to.bounds()));
        self.replaced.iter().map(|replaced| replaced.circle().bounds()).chain(moved)
    }

    /// Whether anything within `rect` may change.
    #[inline]
    pub fn reaches(&self, rect: &Rect) -> bool {
        // A circle that reached the rectangle before its move is now at most this far away.
        let reach = i32::from(REACH);
        let near = Rect::new(rect.x - reach, rect.y - reach, rect.width + 2 * reach, rect.height + 2 * reach);
        !self.moved.and(self.scene.circles.reaching(&near)).is_empty()
            || self.replaced.iter().any(|replaced| replaced.circle().reaches(rect))
    }

    /// Paints the changes of the background, which is `dark` or `lit`, without objects and outlines.
    #[inline]
    pub fn paint(&self, dark: &Pixels, lit: &Pixels, canvas: &mut Canvas<'_>) {
        // The order of the changes does not matter, since everything that a circle of the scene lights ends up lit.
        for (number, from, to) in self.moved() {
            let crescents = crescents(&from, &to);
            let others = self.others(number, &from, crescents);
            for block in &crescents.left {
                let is_lit = others.clone().fold(0, |is_lit, other| is_lit | block.lit_by(&other, &from));
                block.copy(block.visible(&from) & !is_lit, &from, dark, canvas);
            }
            for block in &crescents.entered {
                block.copy(block.visible(&from), &from, lit, canvas);
            }
        }
        for replaced in &self.replaced {
            match replaced {
                Replaced::Appeared(circle) => {
                    for_each_run(circle, |x, rows| copy_rows(x, rows, lit, canvas));
                }
                Replaced::Disappeared(circle) => {
                    for_each_run(circle, |x, rows| copy_rows(x, rows, dark, canvas));
                    for other in self.scene.circles.reaching(&circle.bounds()) {
                        let other = self.scene.circles.get(other);
                        let disc = disc(other.radius);
                        for_each_run(circle, |x, rows| {
                            copy_rows(x, disc.rows(other.centre(), x, &rows), lit, canvas);
                        });
                    }
                }
            }
        }
    }
}

/// Whether `to` may be the same circle as `from`, a few frames later.
fn is_moved(from: &Circle, to: &Circle) -> bool {
    let (x, y) = (to.x - from.x, to.y - from.y);
    from.radius == to.radius && (is_short_move(from.radius, (x, y)) || (x, y) == (0, 0))
}

/// Calls `paint` with each column that a circle covers on the screen below the bar, and its rows there.
fn for_each_run(circle: &Circle, mut paint: impl FnMut(usize, Range<usize>)) {
    let columns = disc(circle.radius).columns(circle.centre(), &(0..SCREEN), BAR_HEIGHT..SCREEN);
    columns.for_each(|DiscColumn { x, rows }| paint(x, rows));
}

/// Copies rows of a background column; an empty range copies nothing.
fn copy_rows(x: usize, rows: Range<usize>, background: &Pixels, canvas: &mut Canvas<'_>) {
    copy_run(background[x][rows.clone()].as_flattened(), canvas.run_mut(x, rows));
}

/// Number of different short moves along one axis.
const MOVES: i16 = 2 * REACH + 1;

/// The pixels of a circle, relative to its centre. `radius` is 0 to [`MAX_SPOT_RADIUS`].
pub(super) fn disc(radius: i16) -> &'static Disc {
    &Shape::of(radius).disc
}

/// The outline of a circle, one pixel wide, relative to its centre.
pub(super) fn outline(radius: i16) -> &'static [(i32, i32)] {
    &Shape::of(radius).outline
}

/// Creates the pixel tables for a radius in advance.
pub(super) fn prepare(radius: i16) {
    Shape::of(radius);
}

/// The pixels that change with a [short move](is_short_move).
#[inline]
fn crescents(from: &Circle, to: &Circle) -> &'static Crescents {
    let (right, down) = (to.x - from.x + REACH, to.y - from.y + REACH);
    &Shape::of(from.radius).crescents[(right * MOVES + down) as usize]
}

/// The pixels of all circles of one radius.
#[derive(Debug)]
struct Shape {
    disc: Disc,
    /// Exactly the pixels of the disc have a [`distance`] below this. `None` for large discs, for which no such number may
    /// exist.
    limit: Option<u16>,
    outline: Vec<(i32, i32)>,
    /// Indexed by the move along both axes. Only up to [`MAX_MOVED_RADIUS`].
    crescents: Vec<Crescents>,
}

impl Shape {
    /// The shape for a radius of 0 to [`MAX_SPOT_RADIUS`], created on first use.
    #[inline]
    fn of(radius: i16) -> &'static Shape {
        static SHAPES: [OnceLock<Shape>; MAX_SPOT_RADIUS as usize + 1] =
            [const { OnceLock::new() }; MAX_SPOT_RADIUS as usize + 1];
        SHAPES[radius as usize].get_or_init(|| Shape::new(radius))
    }

    fn new(radius: i16) -> Self {
        let disc = Disc::new(radius.into());
        let mut crescents = Vec::new();
        if radius <= MAX_MOVED_RADIUS {
            let reach = -i32::from(REACH)..=REACH.into();
            let moves = reach.clone().flat_map(|right| reach.clone().map(move |down| (right, down)));
            crescents.extend(moves.map(|to| Crescents::new(&disc, to)));
        }
        let limit = if radius <= MAX_MOVED_RADIUS { limit(&disc) } else { None };
        Shape { limit, outline: circle_outline(radius.into()), crescents, disc }
    }
}

/// A measure of a pixel's distance from a circle's centre that tells pixels of small circles from others. `x` and `y` are -127
/// to 126, so that squares fit into 16 bits.
#[inline]
fn distance(x: i16, y: i16) -> u16 {
    // Circles are symmetric: the column -1 is as far from the centre as the column 0.
    let odd = |distance: i16| (2 * distance + 3).max(1 - 2 * distance) as u16;
    let square = |distance: i16| odd(distance).wrapping_mul(odd(distance));
    square(x).saturating_add(square(y))
}

/// The smallest [`distance`] of a pixel outside a disc, if all pixels of the disc are nearer.
fn limit(disc: &Disc) -> Option<u16> {
    let radius = disc.radius() as i16;
    let quarter = (0..=radius).flat_map(|x| (0..=radius).map(move |y| (x, y)));
    let (inside, outside): (Vec<_>, Vec<_>) = quarter.partition(|(x, y)| disc.contains(((*x).into(), (*y).into())));
    let limit = outside.iter().map(|(x, y)| distance(*x, *y)).min()?;
    inside.iter().all(|(x, y)| distance(*x, *y) < limit).then_some(limit)
}

/// The pixels whose light changes when a circle moves, relative to the centre before the move.
#[derive(Debug)]
struct Crescents {
    /// The pixels that the circle leaves.
    left: Vec<Block>,
    entered: Vec<Block>,
    /// The smallest rectangle around the pixels in `left`.
    bounds: Edges,
}

impl Crescents {
    /// The changes when a disc of at most [`MAX_MOVED_RADIUS`] moves by `to`, at most [`REACH`] along each axis.
    fn new(disc: &Disc, to: (i32, i32)) -> Self {
        let reach = disc.radius() + i32::from(REACH);
        let square = (-reach..reach).flat_map(|x| (-reach..reach).map(move |y| (x, y)));
        let (mut left, mut entered) = (Vec::new(), Vec::new());
        for (x, y) in square {
            match (disc.contains((x, y)), disc.contains((x - to.0, y - to.1))) {
                (true, false) => left.push((x, y)),
                (false, true) => entered.push((x, y)),
                _ => {}
            }
        }
        let pixel = |(x, y): &(i32, i32)| Rect::new(*x, *y, 1, 1);
        let bounds = left.iter().map(pixel).reduce(|all, pixel| all.union(&pixel)).unwrap_or_default();
        let [left, entered] = [left, entered].map(|pixels| pixels.chunks(LANES).map(Block::new).collect());
        Crescents { left, entered, bounds: Edges::from(&bounds) }
    }

    /// The smallest rectangle around the pixels that a circle leaves.
    #[inline]
    fn bounds_of_left(&self, from: &Circle) -> Edges {
        let Edges { left, top, right, bottom } = self.bounds;
        Edges { left: from.x + left, top: from.y + top, right: from.x + right, bottom: from.y + bottom }
    }
}

/// Pixels in a block. Most crescents have fewer.
const LANES: usize = u32::BITS as usize;

/// Maximum distance of a changed pixel from the centre before the move, along one axis.
const MAX_DISTANCE: i16 = MAX_MOVED_RADIUS + REACH;

/// Number of columns or rows that may separate the pixels of a block.
const CUTS: usize = 2 * MAX_DISTANCE as usize + 2;

/// Up to [`LANES`] pixels, relative to a circle's centre. The bits of one number represent a set of them.
#[derive(Debug)]
struct Block {
    /// Offset in bytes in a frame from the centre's pixel.
    steps: [i16; LANES],
    x: [i8; LANES],
    y: [i8; LANES],
    /// For each column from -[`MAX_DISTANCE`] on, a bit for each pixel to the left of it.
    left_of: [u32; CUTS],
    /// For each row, a bit for each pixel above it.
    above: [u32; CUTS],
}

impl Block {
    fn new(pixels: &[(i32, i32)]) -> Self {
        let mut block = Block { steps: [0; LANES], x: [0; LANES], y: [0; LANES], left_of: [0; CUTS], above: [0; CUTS] };
        for (lane, (x, y)) in pixels.iter().enumerate() {
            (block.x[lane], block.y[lane]) = (*x as i8, *y as i8);
            block.steps[lane] = ((x * SCREEN as i32 + y) * 3) as i16;
            for cut in 0..CUTS {
                let edge = cut as i32 - i32::from(MAX_DISTANCE);
                block.left_of[cut] |= u32::from(*x < edge) << lane;
                block.above[cut] |= u32::from(*y < edge) << lane;
            }
        }
        block
    }

    /// A bit for each pixel on the screen below the bar.
    #[inline]
    fn visible(&self, from: &Circle) -> u32 {
        let cut = |edge: usize, centre: i16| (edge as i16 - centre + MAX_DISTANCE).clamp(0, CUTS as i16 - 1) as usize;
        let columns = self.left_of[cut(SCREEN, from.x)] & !self.left_of[cut(0, from.x)];
        columns & self.above[cut(SCREEN, from.y)] & !self.above[cut(BAR_HEIGHT, from.y)]
    }

    /// A bit for each pixel that another circle lights. The circle must reach one of the pixels.
    fn lit_by(&self, other: &Circle, from: &Circle) -> u32 {
        let Shape { disc, limit, .. } = Shape::of(other.radius);
        let (right, down) = (from.x - other.x, from.y - other.y);
        let mut is_lit = [false; LANES];
        let pixels = self.x.iter().zip(&self.y).map(|(x, y)| (right + i16::from(*x), down + i16::from(*y)));
        let lanes = is_lit.iter_mut().zip(pixels);
        if let Some(limit) = limit {
            // Branchless, so that vector instructions test several pixels at once.
            lanes.for_each(|(is_lit, (x, y))| *is_lit = distance(x, y) < *limit);
        } else {
            lanes.for_each(|(is_lit, (x, y))| *is_lit = disc.contains((x.into(), y.into())));
        }
        is_lit.iter().rev().fold(0, |bits, is_lit| bits << 1 | u32::from(*is_lit))
    }

    /// The position of a pixel on the screen.
    fn pixel(&self, lane: usize, from: &Circle) -> (usize, usize) {
        ((from.x + i16::from(self.x[lane])) as usize, (from.y + i16::from(self.y[lane])) as usize)
    }

    /// Copies some pixels, which must be on the screen.
    #[inline]
    fn copy(&self, pixels: u32, from: &Circle, background: &Pixels, canvas: &mut Canvas<'_>) {
        if canvas.tracks_dirty() {
            for lane in lanes(pixels) {
                let (x, y) = self.pixel(lane, from);
                canvas.mark_dirty(x..x + 1, &(y..y + 1));
            }
        }
        let background = background.as_flattened().as_flattened();
        let frame: &mut Frame = canvas.pixels_mut().try_into().expect("the canvas is a frame");
        let centre = (isize::from(from.x) * SCREEN as isize + isize::from(from.y)) * 3;
        for lane in lanes(pixels) {
            let start = (centre + isize::from(self.steps[lane])) as usize;
            let pixel = start..start + 3;
            // Never off the frame, but an index that may panic would be a call in the loop.
            let (Some(from), Some(to)) = (background.get(pixel.clone()), frame.get_mut(pixel)) else { return };
            to.copy_from_slice(from);
        }
    }
}

/// The lanes whose bits are set.
#[inline]
fn lanes(mut bits: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let lane = bits.trailing_zeros() as usize;
        // Clears the lowest bit.
        (bits != 0).then(|| bits &= bits - 1).map(|()| lane % LANES)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_below_the_limit_are_those_of_the_disc() {
        for radius in 1..=MAX_MOVED_RADIUS {
            let Shape { disc, limit, .. } = Shape::of(radius);
            let limit = limit.unwrap();
            for (x, y) in (-127..=126).flat_map(|x| (-127..=126).map(move |y| (x, y))) {
                assert_eq!(distance(x, y) < limit, disc.contains((x.into(), y.into())), "radius {radius}: {x}, {y}");
            }
        }
        assert_eq!(Shape::of(MAX_MOVED_RADIUS + 1).limit, None);
    }

    #[test]
    fn crescents_hold_the_pixels_that_a_move_leaves_and_enters() {
        let pixels =
            |blocks: &[Block], at: &Circle| blocks.iter().map(|block| block.visible(at).count_ones()).sum::<u32>();
        let [from, to] = [40, 41].map(|y| Circle { x: 20, y, radius: 9 });
        let Crescents { left, entered, .. } = crescents(&from, &to);
        assert_eq!((pixels(left, &from), pixels(entered, &from)), (18, 18), "a pixel in each column at either end");
        assert_eq!(crescents(&from, &to).bounds_of_left(&from), Edges::from(&Rect::new(11, 31, 18, 8)));
        assert!(crescents(&from, &from).left.is_empty());
        let edge = Circle { x: 0, ..from };
        assert_eq!(pixels(left, &edge), 9, "half of it is beyond the screen");
        let large = Circle { radius: MAX_MOVED_RADIUS, ..from };
        let far = Circle { x: large.x + REACH, y: large.y - REACH, ..large };
        assert!(crescents(&large, &far).left.len() > 1, "more than one block is tested");
    }
}
