//! Pixels to draw on, and the filling of runs and blocks that all shapes are made of.

use super::Rgb;

/// Borrowed pixels with a width and a height: what all drawing goes to.
///
/// Everything is clipped to the canvas, so any coordinate is allowed.
#[derive(Debug)]
pub struct Canvas<'a> {
    pixels: &'a mut [u8],
    width: usize,
    height: usize,
}

impl<'a> Canvas<'a> {
    /// A canvas of `width` by `height` pixels over `pixels`, column by column, 3 bytes a pixel.
    ///
    /// # Panics
    ///
    /// When `pixels` does not hold exactly `width * height * 3` bytes.
    #[inline]
    pub fn new(pixels: &'a mut [u8], width: usize, height: usize) -> Self {
        let size = width.checked_mul(height).and_then(|n| n.checked_mul(3));
        assert_eq!(size, Some(pixels.len()), "the canvas' size in bytes");
        Self { pixels, width, height }
    }

    /// Width in pixels.
    #[inline]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    #[inline]
    pub fn height(&self) -> usize {
        self.height
    }

    /// The bytes, column by column, 3 a pixel.
    #[inline]
    pub fn pixels(&self) -> &[u8] {
        self.pixels
    }

    /// The bytes, to be changed.
    #[inline]
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        self.pixels
    }

    /// Paints every pixel.
    pub fn fill(&mut self, color: Rgb) {
        fill_run(self.pixels, color);
    }

    /// Paints one pixel.
    pub(super) fn put(&mut self, x: i64, y: i64, color: Rgb) {
        self.fill_block(x, y, x, y, color);
    }

    /// Paints the row `y` from `x0` to `x1`, both included. As pygame's horizontal runs, the ends
    /// may come in either order.
    pub(super) fn fill_row(&mut self, x0: i64, x1: i64, y: i64, color: Rgb) {
        self.fill_block(x0.min(x1), y, x0.max(x1), y, color);
    }

    /// Paints the columns `x0` to `x1` of the rows `y0` to `y1`, all included; nothing when an end
    /// lies before its start.
    pub(super) fn fill_block(&mut self, x0: i64, y0: i64, x1: i64, y1: i64, color: Rgb) {
        let columns = clip(x0, x1, self.width);
        let rows = clip(y0, y1, self.height);
        if rows.is_empty() {
            return;
        }
        for x in columns {
            let column = x * self.height;
            fill_run(&mut self.pixels[(column + rows.start) * 3..(column + rows.end) * 3], color);
        }
    }
}

/// Paints all pixels of a run.
pub(super) fn fill_run(run: &mut [u8], color: Rgb) {
    // Up to this length, pixels are painted one by one; the rest is copied, twice as much each time.
    let mut painted = run.len().min(96 * 3);
    run[..painted].as_chunks_mut().0.fill(color);
    while painted < run.len() {
        let length = painted.min(run.len() - painted);
        run.copy_within(..length, painted);
        painted += length;
    }
}

/// The part of `first..=last` that lies in `0..size`.
#[inline]
pub(super) fn clip(first: i64, last: i64, size: usize) -> std::ops::Range<usize> {
    let size = size as i64;
    let start = first.clamp(0, size);
    let end = last.saturating_add(1).clamp(start, size);
    start as usize..end as usize
}
