//! Dirty rectangles: the parts of a picture that need repainting.

use super::canvas::Canvas;
use super::rect::Rect;

/// Maximum number of rectangles; more are merged.
const MAX_RECTS: usize = 8;

/// Non-overlapping dirty rectangles of a canvas: the old and new places of what has changed.
#[derive(Clone, Copy, Debug)]
pub struct Damage {
    canvas: Rect,
    rects: [Rect; MAX_RECTS],
    count: usize,
}

impl Damage {
    /// No damage, for a canvas of this size.
    pub fn new(width: usize, height: usize) -> Self {
        let canvas = Rect::new(0, 0, width as i32, height as i32);
        Damage { canvas, rects: [Rect::default(); MAX_RECTS], count: 0 }
    }

    /// Adds a rectangle, clipped to the canvas. Overlapping rectangles are merged into their bounding rectangle.
    #[inline]
    pub fn add(&mut self, rect: Rect) {
        let mut rect = self.canvas.intersection(&rect);
        if rect.width <= 0 || rect.height <= 0 {
            return;
        }
        let mut at = 0;
        while at < self.count {
            // A rectangle that has grown may overlap those that it was already compared with.
            if overlap(&self.rects[at], &rect) || self.count == MAX_RECTS {
                rect = bounding(&self.rects[at], &rect);
                self.count -= 1;
                self.rects[at] = self.rects[self.count];
                at = 0;
            } else {
                at += 1;
            }
        }
        self.rects[self.count] = rect;
        self.count += 1;
    }

    /// Whether a pixel of `rect` is dirty.
    #[inline]
    pub fn overlaps(&self, rect: &Rect) -> bool {
        self.rects().iter().any(|damaged| damaged.overlaps(rect))
    }

    /// The dirty rectangles.
    pub fn rects(&self) -> &[Rect] {
        &self.rects[..self.count]
    }

    /// Calls `paint` for each rectangle, with the canvas clipped to it.
    #[inline]
    pub fn repair(&self, canvas: &mut Canvas<'_>, mut paint: impl FnMut(&mut Canvas<'_>)) {
        self.rects().iter().for_each(|rect| paint(&mut canvas.clipped(*rect)));
    }
}

/// [`Rect::overlaps`] for nonempty rectangles on the canvas, whose sums cannot overflow.
#[inline]
fn overlap(one: &Rect, other: &Rect) -> bool {
    one.x < other.x + other.width
        && other.x < one.x + one.width
        && one.y < other.y + other.height
        && other.y < one.y + one.height
}

/// [`Rect::union`] for nonempty rectangles on the canvas.
#[inline]
fn bounding(one: &Rect, other: &Rect) -> Rect {
    let (x, y) = (one.x.min(other.x), one.y.min(other.y));
    let right = (one.x + one.width).max(other.x + other.width);
    let bottom = (one.y + one.height).max(other.y + other.height);
    Rect { x, y, width: right - x, height: bottom - y }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn covers(rects: &[Rect], x: i32, y: i32) -> usize {
        rects.iter().filter(|rect| rect.overlaps(&Rect::new(x, y, 1, 1))).count()
    }

    proptest! {
        #[test]
        fn every_damaged_pixel_is_painted_once(
            added in prop::collection::vec((-9..30_i32, -9..30_i32, -2..12_i32, -2..12_i32), 0..20),
        ) {
            let added: Vec<Rect> = added.iter().map(|&(x, y, width, height)| Rect::new(x, y, width, height)).collect();
            let mut damage = Damage::new(24, 16);
            added.iter().for_each(|rect| damage.add(*rect));
            for (x, y) in (-9..40).flat_map(|x| (-9..40).map(move |y| (x, y))) {
                let on_canvas = (0..24).contains(&x) && (0..16).contains(&y);
                let painted = covers(damage.rects(), x, y);
                prop_assert!(painted <= usize::from(on_canvas));
                prop_assert!(painted == 1 || !on_canvas || covers(&added, x, y) == 0);
            }
        }
    }

    #[test]
    fn rectangles_beyond_the_canvas_are_ignored() {
        let mut damage = Damage::new(84, 84);
        damage.add(Rect::new(i32::MAX, 3, i32::MAX, 4));
        damage.add(Rect::new(i32::MIN, i32::MIN, 5, 5));
        assert!(damage.rects().is_empty());
    }
}
