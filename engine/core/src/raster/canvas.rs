//! Borrowed pixels to draw on, and the blocks and rows that make up all shapes.

use std::ops::Range;

use super::rect::Rect;
use super::runs::{Rgb, clip, copy_run, fill_run};

/// Borrowed pixels with a width and a height: the target of all drawing.
///
/// Drawing is clipped to the canvas, so any coordinate is allowed. On a [`clipped`](Canvas::clipped) canvas only the pixels of
/// a rectangle change, so that part of a picture can be repainted.
#[derive(Debug)]
pub struct Canvas<'a> {
    pixels: &'a mut [u8],
    width: usize,
    height: usize,
    /// The pixels that may change.
    columns: Range<usize>,
    rows: Range<usize>,
    /// For each column, a mask with a bit for each row, set when the pixel is painted. `None` without dirty tracking.
    dirty: Option<&'a mut [u128]>,
}

impl<'a> Canvas<'a> {
    /// A canvas of `width` by `height` pixels over `pixels`, column by column, 3 bytes per pixel.
    ///
    /// # Panics
    ///
    /// If `pixels` does not have exactly `width * height * 3` bytes.
    #[inline]
    pub fn new(pixels: &'a mut [u8], width: usize, height: usize) -> Self {
        let size = width.checked_mul(height).and_then(|n| n.checked_mul(3));
        assert_eq!(size, Some(pixels.len()), "the canvas' size in bytes");
        Self { pixels, width, height, columns: 0..width, rows: 0..height, dirty: None }
    }

    /// The same canvas with dirty tracking: painted pixels are marked in `dirty`, which has a mask for each column with a bit
    /// for each row.
    ///
    /// # Panics
    ///
    /// If there are more columns than masks, or more than 128 rows.
    pub(super) fn tracking_dirty(self, dirty: &'a mut [u128]) -> Self {
        assert!(dirty.len() >= self.width && self.height <= u128::BITS as usize);
        Self { dirty: Some(dirty), ..self }
    }

    /// Whether painted pixels are marked as dirty.
    #[inline]
    pub fn tracks_dirty(&self) -> bool {
        self.dirty.is_some()
    }

    /// Marks some rows of some columns as dirty. Does nothing without dirty tracking.
    ///
    /// # Panics
    ///
    /// With dirty tracking, if a column or row is out of range.
    #[inline]
    pub fn mark_dirty(&mut self, columns: Range<usize>, rows: &Range<usize>) {
        if let Some(dirty) = &mut self.dirty {
            mark_rows(&mut dirty[columns], rows);
        }
    }

    /// The same canvas, with changes restricted to `rect`.
    #[inline]
    pub fn clipped(&mut self, rect: Rect) -> Canvas<'_> {
        let columns = clip(rect.x.into(), i64::from(rect.x) + i64::from(rect.width) - 1, &self.columns);
        let rows = clip(rect.y.into(), i64::from(rect.y) + i64::from(rect.height) - 1, &self.rows);
        let dirty = self.dirty.as_deref_mut();
        Canvas { pixels: self.pixels, width: self.width, height: self.height, columns, rows, dirty }
    }

    /// The columns that may change.
    #[inline]
    pub fn columns(&self) -> Range<usize> {
        self.columns.clone()
    }

    /// The rows that may change.
    #[inline]
    pub fn rows(&self) -> Range<usize> {
        self.rows.clone()
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

    /// All bytes, column by column, 3 per pixel.
    #[inline]
    pub fn pixels(&self) -> &[u8] {
        self.pixels
    }

    /// All bytes, mutably. The caller must stay within [`columns`](Canvas::columns) and [`rows`](Canvas::rows), and
    /// [mark](Canvas::mark_dirty) the pixels that it paints.
    #[inline]
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        self.pixels
    }

    /// Some rows of a column, marked as dirty. The caller must stay within [`columns`](Canvas::columns) and
    /// [`rows`](Canvas::rows).
    #[inline]
    pub fn run_mut(&mut self, x: usize, rows: Range<usize>) -> &mut [u8] {
        self.mark_dirty(x..x + 1, &rows);
        let column = x * self.height;
        &mut self.pixels[(column + rows.start) * 3..(column + rows.end) * 3]
    }

    /// One pixel, marked as dirty. The caller must stay within [`columns`](Canvas::columns) and [`rows`](Canvas::rows).
    #[inline]
    pub fn pixel_mut(&mut self, x: usize, y: usize) -> &mut Rgb {
        self.mark_dirty(x..x + 1, &(y..y + 1));
        &mut self.pixels.as_chunks_mut::<3>().0[x * self.height + y]
    }

    /// The part of each column that may change, with the column's index. Marks all of them as dirty.
    #[inline]
    pub fn runs_mut(&mut self) -> impl Iterator<Item = (usize, &mut [u8])> {
        self.mark_dirty(self.columns.clone(), &self.rows.clone());
        let (height, rows) = (self.height * 3, self.rows.start * 3..self.rows.end * 3);
        let columns =
            self.pixels[self.columns.start * height..self.columns.end * height].chunks_exact_mut(height.max(1));
        self.columns.clone().zip(columns).map(move |(x, column)| (x, &mut column[rows.clone()]))
    }

    /// Paints every pixel.
    pub fn fill(&mut self, color: Rgb) {
        if self.is_whole() {
            self.mark_dirty(0..self.width, &(0..self.height));
            fill_run(self.pixels, color);
        } else {
            self.runs_mut().for_each(|(_, run)| fill_run(run, color));
        }
    }

    /// Copies every pixel from a picture with the size of the canvas.
    #[inline]
    pub fn paste(&mut self, picture: &[u8]) {
        self.mark_dirty(self.columns.clone(), &self.rows.clone());
        let height = self.height;
        if self.rows.len() == height {
            // Whole columns are one run.
            let bytes = self.columns.start * height * 3..self.columns.end * height * 3;
            return self.pixels[bytes.clone()].copy_from_slice(&picture[bytes]);
        }
        let length = self.rows.len() * 3;
        for x in self.columns.clone() {
            let start = (x * height + self.rows.start) * 3;
            copy_run(&picture[start..start + length], &mut self.pixels[start..start + length]);
        }
    }

    fn is_whole(&self) -> bool {
        self.columns.len() == self.width && self.rows.len() == self.height
    }

    /// Paints one pixel.
    pub(super) fn put(&mut self, x: i64, y: i64, color: Rgb) {
        self.fill_block(x, y, x, y, color);
    }

    /// Paints the row `y` from `x0` to `x1`, both included. As in pygame's horizontal runs, the ends may come in either order.
    pub(super) fn fill_row(&mut self, x0: i64, x1: i64, y: i64, color: Rgb) {
        self.fill_block(x0.min(x1), y, x0.max(x1), y, color);
    }

    /// Paints the columns `x0` to `x1` of the rows `y0` to `y1`, all included; nothing if an end lies before its start.
    pub(super) fn fill_block(&mut self, x0: i64, y0: i64, x1: i64, y1: i64, color: Rgb) {
        let columns = clip(x0, x1, &self.columns);
        let rows = clip(y0, y1, &self.rows);
        if rows.is_empty() {
            return;
        }
        for x in columns {
            fill_run(self.run_mut(x, rows.clone()), color);
        }
    }
}

/// Sets the bits of some rows in the masks of several columns.
fn mark_rows(masks: &mut [u128], rows: &Range<usize>) {
    if rows.start < rows.end {
        let bits = u128::MAX >> (u128::BITS as usize - rows.len()) << rows.start;
        masks.iter_mut().for_each(|column| *column |= bits);
    }
}
