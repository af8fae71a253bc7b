//! Pictures that are painted often: compiled to the runs of their opaque pixels.

use std::ops::Range;

use super::blit::opaque_runs;
use super::canvas::clip;
use super::{Canvas, Disc, Rect, Surface, blend_keyed};

/// A picture whose opaque pixels are stored as vertical runs, which are contiguous on a canvas.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sprite {
    runs: Vec<Run>,
    /// The pixels of all runs, one run after the other.
    pixels: Vec<u8>,
    bounds: Rect,
}

/// Opaque pixels of one column, without a gap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Run {
    /// Position of the first pixel from the sprite's top left corner.
    x: u32,
    y: u32,
    /// Length in pixels.
    length: u32,
    /// First byte within the sprite's pixels.
    start: u32,
}

impl Sprite {
    /// Compiles a surface: all pixels but those of its colour key. The surface's alpha does not
    /// count; a sprite is opaque.
    pub fn new(surface: &Surface) -> Self {
        let mut runs = Vec::new();
        let mut pixels = Vec::new();
        let key = surface.color_key();
        let columns = surface.pixels().as_chunks::<3>().0.chunks_exact(surface.height().max(1));
        for (x, column) in columns.enumerate() {
            for (y, run) in opaque_runs(column, key) {
                let start = pixels.len() as u32;
                pixels.extend_from_slice(run.as_flattened());
                runs.push(Run { x: x as u32, y: y as u32, length: run.len() as u32, start });
            }
        }
        let bounds = bounds(&runs);
        Self { runs, pixels, bounds }
    }

    /// The smallest rectangle about the opaque pixels, from the sprite's top left corner: what
    /// [`Sprite::blit`] at `(0, 0)` can change. Without opaque pixels its size is 0.
    pub fn bounds(&self) -> Rect {
        self.bounds
    }

    /// Paints the sprite with its top left corner at `(x, y)`: the same pixels as the surface's
    /// [`Canvas::blit`] at full alpha.
    #[inline]
    pub fn blit(&self, canvas: &mut Canvas<'_>, x: i32, y: i32) {
        let left = i64::from(x) + i64::from(self.bounds.x);
        let top = i64::from(y) + i64::from(self.bounds.y);
        let right = left + i64::from(self.bounds.width);
        let bottom = top + i64::from(self.bounds.height);
        let (columns, rows) = (canvas.columns(), canvas.rows());
        let (first, end) = (columns.start as i64, columns.end as i64);
        let (highest, lowest) = (rows.start as i64, rows.end as i64);
        if left >= first && top >= highest && right <= end && bottom <= lowest {
            self.blit_whole(canvas, x, y);
        } else if right > first && bottom > highest && left < end && top < lowest {
            self.blit_clipped(canvas, i64::from(x), i64::from(y));
        }
    }

    /// The smallest rectangle about the opaque pixels of the sprite with its top left corner at `(x, y)`.
    #[inline]
    pub fn bounds_at(&self, (x, y): (i32, i32)) -> Rect {
        Rect { x: x.saturating_add(self.bounds.x), y: y.saturating_add(self.bounds.y), ..self.bounds }
    }

    /// Paints a sprite whose bounds may change as a whole.
    #[inline]
    fn blit_whole(&self, canvas: &mut Canvas<'_>, x: i32, y: i32) {
        let mut remaining = self.pixels.as_slice();
        for run in &self.runs {
            // The sprite's empty margin may reach beyond the canvas; the runs do not.
            let (column, row) = ((x + run.x as i32) as usize, (y + run.y as i32) as usize);
            let (source, rest) = remaining.split_at(run.length as usize * 3);
            remaining = rest;
            copy_run(source, canvas.run_mut(column, row..row + run.length as usize));
        }
    }

    /// Paints the part of the sprite that lies on the canvas.
    fn blit_clipped(&self, canvas: &mut Canvas<'_>, x: i64, y: i64) {
        for (column, rows, source) in self.runs_on(canvas.columns(), canvas.rows(), x, y) {
            canvas.run_mut(column, rows).copy_from_slice(source);
        }
    }

    /// Paints the part of the sprite that lies on the canvas within the disc about `center`.
    pub fn blit_within(&self, canvas: &mut Canvas<'_>, x: i32, y: i32, disc: &Disc, center: (i32, i32)) {
        let overlaps = |at: i32, length: i32, center: i32| {
            let (start, center, radius) = (i64::from(at), i64::from(center), i64::from(disc.radius()));
            start < center + radius && center - radius < start + i64::from(length)
        };
        let bounds = self.bounds;
        if !overlaps(x.saturating_add(bounds.x), bounds.width, center.0)
            || !overlaps(y.saturating_add(bounds.y), bounds.height, center.1)
        {
            return;
        }
        for (column, rows, source) in self.runs_on(canvas.columns(), canvas.rows(), i64::from(x), i64::from(y)) {
            let lit = disc.rows(center, column, &rows);
            if !lit.is_empty() {
                let source = &source[(lit.start - rows.start) * 3..(lit.end - rows.start) * 3];
                canvas.run_mut(column, lit).copy_from_slice(source);
            }
        }
    }

    /// Paints the sprite as it looks under a black surface of some `alpha` that has a colour key: 0 as it is, 255 black.
    pub fn blit_shaded(&self, canvas: &mut Canvas<'_>, x: i32, y: i32, alpha: u8) {
        for (column, rows, source) in self.runs_on(canvas.columns(), canvas.rows(), i64::from(x), i64::from(y)) {
            let target = canvas.run_mut(column, rows);
            target.iter_mut().zip(source).for_each(|(target, source)| *target = blend_keyed(0, *source, alpha));
        }
    }

    /// The parts of the runs that lie in some columns and rows, for a sprite with its top left corner at `(x, y)`: column,
    /// rows, pixels.
    fn runs_on(
        &self,
        columns: Range<usize>,
        rows: Range<usize>,
        x: i64,
        y: i64,
    ) -> impl Iterator<Item = (usize, Range<usize>, &[u8])> {
        let columns = columns.start as i64..columns.end as i64;
        self.runs.iter().filter_map(move |run| {
            let column = x + i64::from(run.x);
            let row = y + i64::from(run.y);
            let rows = clip(row, row + i64::from(run.length) - 1, &rows);
            if rows.is_empty() || !columns.contains(&column) {
                return None;
            }
            let start = run.start as usize + (rows.start as i64 - row) as usize * 3;
            Some((column as usize, rows.clone(), &self.pixels[start..start + rows.len() * 3]))
        })
    }
}

/// The smallest rectangle about some runs.
fn bounds(runs: &[Run]) -> Rect {
    let left = runs.iter().map(|run| run.x).min().unwrap_or(0);
    let right = runs.iter().map(|run| run.x + 1).max().unwrap_or(0);
    let top = runs.iter().map(|run| run.y).min().unwrap_or(0);
    let bottom = runs.iter().map(|run| run.y + run.length).max().unwrap_or(0);
    Rect::new(left as i32, top as i32, (right - left) as i32, (bottom - top) as i32)
}

/// Copies a short run between slices of the same length. Blocks of fixed sizes are moved in registers,
/// where a copy of any length would be a call; the last block overlaps the one before it.
#[inline]
pub fn copy_run(source: &[u8], target: &mut [u8]) {
    if source.len() >= 32 {
        copy_blocks::<32>(source, target);
    } else if source.len() >= 16 {
        copy_blocks::<16>(source, target);
    } else if source.len() >= 8 {
        copy_blocks::<8>(source, target);
    } else {
        copy_blocks::<3>(source, target);
    }
}

#[inline]
fn copy_blocks<const N: usize>(source: &[u8], target: &mut [u8]) {
    for (source, target) in source.as_chunks::<N>().0.iter().zip(target.as_chunks_mut::<N>().0) {
        *target = *source;
    }
    if let (Some(source), Some(target)) = (source.last_chunk::<N>(), target.last_chunk_mut::<N>()) {
        *target = *source;
    }
}
