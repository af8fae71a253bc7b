//! Pictures that are painted often: compiled to the runs of their opaque pixels.

use super::blit::opaque_runs;
use super::canvas::clip;
use super::{Canvas, Rect, Surface};

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
        let (width, height) = (canvas.width() as i64, canvas.height() as i64);
        if left >= 0 && top >= 0 && right <= width && bottom <= height {
            self.blit_whole(canvas, x, y);
        } else if right > 0 && bottom > 0 && left < width && top < height {
            self.blit_clipped(canvas, i64::from(x), i64::from(y));
        }
    }

    /// Paints a sprite whose bounds lie on the canvas.
    #[inline]
    fn blit_whole(&self, canvas: &mut Canvas<'_>, x: i32, y: i32) {
        let height = canvas.height();
        // Negative where the sprite's empty margin reaches beyond the canvas; the runs do not.
        let corner = i64::from(x) * height as i64 + i64::from(y);
        let pixels = canvas.pixels_mut();
        let mut remaining = self.pixels.as_slice();
        for run in &self.runs {
            let start = (corner + i64::from(run.x) * height as i64 + i64::from(run.y)) as usize * 3;
            let (source, rest) = remaining.split_at(run.length as usize * 3);
            remaining = rest;
            copy_run(source, &mut pixels[start..][..source.len()]);
        }
    }

    /// Paints the part of the sprite that lies on the canvas.
    #[cold]
    fn blit_clipped(&self, canvas: &mut Canvas<'_>, x: i64, y: i64) {
        let (width, height) = (canvas.width(), canvas.height());
        let pixels = canvas.pixels_mut();
        for run in &self.runs {
            let column = x + i64::from(run.x);
            let row = y + i64::from(run.y);
            let rows = clip(row, row + i64::from(run.length) - 1, height);
            if rows.is_empty() || !(0..width as i64).contains(&column) {
                continue;
            }
            let start = (column as usize * height + rows.start) * 3;
            let source_start = run.start as usize + (rows.start as i64 - row) as usize * 3;
            let length = rows.len() * 3;
            pixels[start..][..length].copy_from_slice(&self.pixels[source_start..][..length]);
        }
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

/// Copies a short run. Blocks of fixed sizes are moved in registers, where a copy of any length
/// would be a call; the last block overlaps the one before it.
#[inline]
fn copy_run(source: &[u8], target: &mut [u8]) {
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
