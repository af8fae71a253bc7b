//! Where circles of light lie, as one span of rows for each column: coarse, and found by a few vector instructions.

use super::circle::Circle;
use super::config::BAR_HEIGHT;
use super::crescents::MAX_MOVED_RADIUS;
use super::shape::Shape;
use crate::envs::screen::SCREEN;
use crate::raster::DiscColumn;

const RADIUS: usize = MAX_MOVED_RADIUS as usize;

/// Columns beside the screen that a circle may cover.
const BESIDE: usize = 2 * RADIUS;

/// What is added to a distance from the screen's edge, such that it is positive for every circle that touches the screen.
const BIAS: i16 = 2 * MAX_MOVED_RADIUS;

/// For each column of the screen, and those beside it, the smallest span of rows that has the pixels of some circles.
pub(super) struct LightSpans {
    /// Distances of the first rows from the screen's top edge, and of the last from its bottom edge, plus [`BIAS`]; [`u8::MAX`] in
    /// a column without a pixel.
    above: [u8; SCREEN + 2 * BESIDE],
    below: [u8; SCREEN + 2 * BESIDE],
}

impl LightSpans {
    /// No pixel.
    pub fn new() -> Self {
        LightSpans { above: [u8::MAX; SCREEN + 2 * BESIDE], below: [u8::MAX; SCREEN + 2 * BESIDE] }
    }

    /// Adds a circle that touches the screen.
    #[inline]
    pub fn add(&mut self, circle: &Circle) {
        let shape = Shape::of(circle.radius);
        if circle.radius > MAX_MOVED_RADIUS {
            for DiscColumn { x, rows } in shape.extent.disc.columns(circle.centre(), &(0..SCREEN), 0..SCREEN) {
                let (above, below) = (&mut self.above[BESIDE + x], &mut self.below[BESIDE + x]);
                *above = (*above).min(BIAS as u8 + rows.start as u8);
                *below = (*below).min(BIAS as u8 + (SCREEN - rows.end) as u8);
            }
            return;
        }
        let first = (BESIDE as i16 + circle.x - circle.radius) as usize;
        let to_top = (circle.y - MAX_MOVED_RADIUS + BIAS) as u8;
        let to_bottom = (SCREEN as i16 - circle.y - MAX_MOVED_RADIUS + BIAS) as u8;
        for (spans, distance) in [(&mut self.above, to_top), (&mut self.below, to_bottom)] {
            if let Some(spans) = spans[first..].first_chunk_mut::<{ 2 * RADIUS }>() {
                for (span, margin) in spans.iter_mut().zip(&shape.margins) {
                    *span = (*span).min(margin.saturating_add(distance));
                }
            }
        }
    }

    /// The first row of each column, and the one behind the last, of what is visible on the screen below the bar. Without a pixel
    /// the second is 0.
    #[inline]
    pub fn on_screen(&self) -> ([u8; SCREEN], [u8; SCREEN]) {
        const TOP: u8 = BIAS as u8;
        const BOTTOM: u8 = BIAS as u8 + SCREEN as u8;
        let (mut firsts, mut ends) = ([0; SCREEN], [0; SCREEN]);
        let spans = self.above[BESIDE..].iter().zip(&self.below[BESIDE..]);
        for ((first, end), (above, below)) in firsts.iter_mut().zip(&mut ends).zip(spans) {
            *first = (*above).clamp(TOP + BAR_HEIGHT as u8, BOTTOM) - TOP;
            *end = BOTTOM - (*below).clamp(TOP, BOTTOM);
        }
        (firsts, ends)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::envs::searing_spotlights::parameters::MAX_SPOT_RADIUS;

    #[test]
    fn spans_are_the_visible_columns_of_a_circle() {
        let side = SCREEN as i16;
        for radius in 1..=MAX_SPOT_RADIUS as i16 {
            let near = |at: i16| (at - radius..=at + radius).step_by(5);
            for (x, y) in near(0).chain(near(side)).flat_map(|x| near(0).chain(near(side)).map(move |y| (x, y))) {
                let circle = Circle { x, y, radius };
                if !circle.is_on_screen() {
                    continue;
                }
                let mut spans = LightSpans::new();
                spans.add(&circle);
                let (firsts, ends) = spans.on_screen();
                let mut expected = [0..0; 0].to_vec();
                expected.resize(SCREEN, 0..0);
                let disc = &Shape::of(radius).extent.disc;
                for DiscColumn { x, rows } in disc.columns((x.into(), y.into()), &(0..SCREEN), BAR_HEIGHT..SCREEN) {
                    expected[x] = rows;
                }
                for (x, expected) in expected.iter().enumerate() {
                    let found = usize::from(firsts[x])..usize::from(ends[x]);
                    assert!(found == *expected || (found.is_empty() && expected.is_empty()), "{circle:?}: {x}");
                }
            }
        }
    }

    #[test]
    fn spans_have_all_circles() {
        let mut spans = LightSpans::new();
        assert_eq!(spans.on_screen().1, [0; SCREEN]);
        for (x, y) in [(20, 30), (20, 60), (70, 40)] {
            spans.add(&Circle { x, y, radius: 8 });
        }
        let (firsts, ends) = spans.on_screen();
        assert_eq!((firsts[20], ends[20]), (22, 68));
        assert_eq!((firsts[70], ends[70]), (32, 48));
        assert_eq!((ends[11], ends[28], ends[45]), (0, 0, 0));
    }
}
