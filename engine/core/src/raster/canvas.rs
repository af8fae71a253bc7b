//! Pixels to draw on, and the filling of runs and blocks that all shapes are made of.

use std::ops::Range;

use super::{Rect, Rgb, copy_run};

/// Borrowed pixels with a width and a height: what all drawing goes to.
///
/// Everything is clipped to the canvas, so any coordinate is allowed. A [`clipped`](Canvas::clipped) canvas lets only a
/// rectangle of its pixels change, which is how a part of a picture is painted anew.
#[derive(Debug)]
pub struct Canvas<'a> {
    pixels: &'a mut [u8],
    width: usize,
    height: usize,
    /// The pixels that may change.
    columns: Range<usize>,
    rows: Range<usize>,
    /// Of each column, a bit for each row in which a pixel was painted; `None` where nobody wants to know.
    painted: Option<&'a mut [u128]>,
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
        Self { pixels, width, height, columns: 0..width, rows: 0..height, painted: None }
    }

    /// The same canvas, which notes what is painted: by column, a bit for each row.
    ///
    /// # Panics
    ///
    /// When there are more columns than numbers, or more rows than bits.
    pub(super) fn noting(self, painted: &'a mut [u128]) -> Self {
        assert!(painted.len() >= self.width && self.height <= u128::BITS as usize);
        Self { painted: Some(painted), ..self }
    }

    /// Whether somebody wants to know what is painted.
    #[inline]
    pub fn is_noting(&self) -> bool {
        self.painted.is_some()
    }

    /// Notes that some rows of some columns are painted.
    #[inline]
    pub fn note(&mut self, columns: Range<usize>, rows: &Range<usize>) {
        if let Some(painted) = &mut self.painted {
            note(&mut painted[columns], rows);
        }
    }

    /// The same canvas, of which only what lies in `rect` may change.
    #[inline]
    pub fn clipped(&mut self, rect: Rect) -> Canvas<'_> {
        let columns = clip(rect.x.into(), i64::from(rect.x) + i64::from(rect.width) - 1, &self.columns);
        let rows = clip(rect.y.into(), i64::from(rect.y) + i64::from(rect.height) - 1, &self.rows);
        let painted = self.painted.as_deref_mut();
        Canvas { pixels: self.pixels, width: self.width, height: self.height, columns, rows, painted }
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

    /// All bytes, column by column, 3 a pixel.
    #[inline]
    pub fn pixels(&self) -> &[u8] {
        self.pixels
    }

    /// All bytes, to be changed; whoever does keeps to [`columns`](Canvas::columns) and [`rows`](Canvas::rows), and
    /// [notes](Canvas::note) what it paints.
    #[inline]
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        self.pixels
    }

    /// Some rows of a column, all of which are to be painted; whoever does keeps to [`columns`](Canvas::columns) and
    /// [`rows`](Canvas::rows).
    #[inline]
    pub fn run_mut(&mut self, x: usize, rows: Range<usize>) -> &mut [u8] {
        self.note(x..x + 1, &rows);
        let column = x * self.height;
        &mut self.pixels[(column + rows.start) * 3..(column + rows.end) * 3]
    }

    /// One pixel that is to be painted.
    #[inline]
    pub fn pixel_mut(&mut self, x: usize, y: usize) -> &mut Rgb {
        self.note(x..x + 1, &(y..y + 1));
        &mut self.pixels.as_chunks_mut::<3>().0[x * self.height + y]
    }

    /// The part of each column that may change, with its column; all of it is to be painted.
    #[inline]
    pub fn runs_mut(&mut self) -> impl Iterator<Item = (usize, &mut [u8])> {
        self.note(self.columns.clone(), &self.rows.clone());
        let (height, rows) = (self.height * 3, self.rows.start * 3..self.rows.end * 3);
        let columns =
            self.pixels[self.columns.start * height..self.columns.end * height].chunks_exact_mut(height.max(1));
        self.columns.clone().zip(columns).map(move |(x, column)| (x, &mut column[rows.clone()]))
    }

    /// Paints every pixel.
    pub fn fill(&mut self, color: Rgb) {
        if self.is_whole() {
            self.note(0..self.width, &(0..self.height));
            fill_run(self.pixels, color);
        } else {
            self.runs_mut().for_each(|(_, run)| fill_run(run, color));
        }
    }

    /// Copies every pixel from a picture of the canvas' size.
    #[inline]
    pub fn paste(&mut self, picture: &[u8]) {
        if self.is_whole() {
            self.note(0..self.width, &(0..self.height));
            self.pixels.copy_from_slice(picture);
            return;
        }
        self.note(self.columns.clone(), &self.rows.clone());
        let height = self.height;
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

    /// Paints the row `y` from `x0` to `x1`, both included. As pygame's horizontal runs, the ends
    /// may come in either order.
    pub(super) fn fill_row(&mut self, x0: i64, x1: i64, y: i64, color: Rgb) {
        self.fill_block(x0.min(x1), y, x0.max(x1), y, color);
    }

    /// Paints the columns `x0` to `x1` of the rows `y0` to `y1`, all included; nothing when an end
    /// lies before its start.
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

/// Notes that some rows of columns are painted.
fn note(painted: &mut [u128], rows: &Range<usize>) {
    if rows.start < rows.end {
        let bits = u128::MAX >> (u128::BITS as usize - rows.len()) << rows.start;
        painted.iter_mut().for_each(|column| *column |= bits);
    }
}

/// Paints all pixels of a run.
pub(super) fn fill_run(run: &mut [u8], color: Rgb) {
    if color == [color[0]; 3] {
        return fill_bytes(run, color[0]);
    }
    // Up to this length, pixels are painted one by one; the rest is copied, twice as much each time.
    let mut painted = run.len().min(96 * 3);
    run[..painted].as_chunks_mut().0.fill(color);
    while painted < run.len() {
        let length = painted.min(run.len() - painted);
        run.copy_within(..length, painted);
        painted += length;
    }
}

/// Fills bytes: a few of them in registers, where filling any number would be a call.
#[inline]
fn fill_bytes(bytes: &mut [u8], byte: u8) {
    match bytes.len() {
        16..32 => fill_ends::<16>(bytes, byte),
        32..64 => fill_ends::<32>(bytes, byte),
        _ => bytes.fill(byte),
    }
}

/// Fills the first `N` bytes and the last.
#[inline]
fn fill_ends<const N: usize>(bytes: &mut [u8], byte: u8) {
    if let Some(first) = bytes.first_chunk_mut::<N>() {
        *first = [byte; N];
    }
    if let Some(last) = bytes.last_chunk_mut::<N>() {
        *last = [byte; N];
    }
}

/// The part of `first..=last` that lies in `within`.
#[inline]
pub(super) fn clip(first: i64, last: i64, within: &Range<usize>) -> Range<usize> {
    let (low, high) = (within.start as i64, within.end as i64);
    let start = first.clamp(low, high);
    let end = last.saturating_add(1).clamp(start, high);
    start as usize..end as usize
}
