//! Pictures that are painted often, compiled to the runs of their opaque pixels.

use std::ops::Range;

use super::blit::{blend_keyed, opaque_runs};
use super::canvas::Canvas;
use super::circle::Disc;
use super::rect::Rect;
use super::runs::{clip, copy_run};
use super::surface::Surface;

/// A picture stored as vertical runs of opaque pixels, which are contiguous on a canvas.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sprite {
    runs: Vec<Run>,
    /// The pixels of all runs, one run after the other.
    pixels: Vec<u8>,
    bounds: Rect,
    /// The same pixels in blocks of fixed sizes, for painting the whole sprite.
    blocks: Blocks,
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
    /// Compiles all pixels of a surface except those of its colour key. The surface's alpha has no effect; a sprite is opaque.
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
        Self::from_runs(runs, pixels)
    }

    fn from_runs(runs: Vec<Run>, pixels: Vec<u8>) -> Self {
        let (bounds, blocks) = (bounds(&runs), Blocks::new(&runs, &pixels));
        Self { runs, pixels, bounds, blocks }
    }

    /// The bounding rectangle of the opaque pixels, relative to the sprite's top left corner: what [`Sprite::blit`] at `(0, 0)`
    /// can change. Without opaque pixels its size is 0.
    pub fn bounds(&self) -> Rect {
        self.bounds
    }

    /// Paints the sprite with its top left corner at `(x, y)`: the same pixels as [`Canvas::blit`] of the surface at full
    /// alpha.
    #[inline]
    pub fn blit(&self, canvas: &mut Canvas<'_>, x: i32, y: i32) {
        let left = i64::from(x) + i64::from(self.bounds.x);
        let top = i64::from(y) + i64::from(self.bounds.y);
        let right = left + i64::from(self.bounds.width);
        let bottom = top + i64::from(self.bounds.height);
        let (columns, rows) = (canvas.columns(), canvas.rows());
        let (first, end) = (columns.start as i64, columns.end as i64);
        let (highest, lowest) = (rows.start as i64, rows.end as i64);
        if left >= first && top >= highest && right <= end && bottom <= lowest && !canvas.tracks_dirty() {
            // Negative if the sprite's empty margin extends beyond the canvas; the blocks do not.
            let corner = i64::from(x) * canvas.height() as i64 + i64::from(y);
            self.blocks.copy(corner, canvas);
        } else if right > first && bottom > highest && left < end && top < lowest {
            self.blit_clipped(canvas, i64::from(x), i64::from(y));
        }
    }

    /// The bounding rectangle of the opaque pixels when the sprite's top left corner is at `(x, y)`.
    #[inline]
    pub fn bounds_at(&self, (x, y): (i32, i32)) -> Rect {
        Rect { x: x.saturating_add(self.bounds.x), y: y.saturating_add(self.bounds.y), ..self.bounds }
    }

    /// Paints the part of the sprite that lies on the canvas, run by run.
    fn blit_clipped(&self, canvas: &mut Canvas<'_>, x: i64, y: i64) {
        for (column, rows, source) in self.runs_on(canvas.columns(), canvas.rows(), x, y) {
            copy_run(source, canvas.run_mut(column, rows));
        }
    }

    /// Paints the part of the sprite that lies on the canvas and within the disc about `center`.
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
        let (columns, rows) = (canvas.columns(), canvas.rows());
        let (x, y, top) = (i64::from(x), i64::from(y), i64::from(center.1));
        for run in &self.runs {
            let (column, row) = (x + i64::from(run.x), y + i64::from(run.y));
            let half = i64::from(disc.half_height(column - i64::from(center.0)));
            let first = row.max(rows.start as i64).max(top - half);
            let end = (row + i64::from(run.length)).min(rows.end as i64).min(top + half);
            if first < end && columns.contains(&(column as usize)) {
                let length = (end - first) as usize * 3;
                let source = &self.pixels[run.start as usize + (first - row) as usize * 3..][..length];
                copy_run(source, canvas.run_mut(column as usize, first as usize..end as usize));
            }
        }
    }

    /// The sprite as seen through a black surface with a colour key and the given `alpha`: 0 changes nothing, 255 is black.
    pub fn shaded(&self, alpha: u8) -> Sprite {
        let pixels = self.pixels.iter().map(|channel| blend_keyed(0, *channel, alpha)).collect();
        Self::from_runs(self.runs.clone(), pixels)
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

/// Runs grouped by length, each as two blocks of a fixed size that may overlap. A copy of fixed size is a few moves, without a
/// loop or a call.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Blocks {
    one: BlocksOf<3>,
    two: BlocksOf<6>,
    four: BlocksOf<12>,
    eight: BlocksOf<24>,
    sixteen: BlocksOf<48>,
}

impl Blocks {
    fn new(runs: &[Run], pixels: &[u8]) -> Self {
        let mut blocks = Self::default();
        for run in runs {
            // At most two of the largest blocks at a time.
            for above in (0..run.length).step_by(32) {
                let (y, length) = (run.y + above, (run.length - above).min(32));
                let pixels = &pixels[(run.start + above * 3) as usize..][..length as usize * 3];
                match length {
                    0..2 => blocks.one.add(run.x, y, pixels),
                    2..4 => blocks.two.add(run.x, y, pixels),
                    4..8 => blocks.four.add(run.x, y, pixels),
                    8..16 => blocks.eight.add(run.x, y, pixels),
                    16.. => blocks.sixteen.add(run.x, y, pixels),
                }
            }
        }
        blocks
    }

    /// Paints all blocks. `corner` is the index of the pixel at the sprite's top left corner, column by column.
    #[inline]
    fn copy(&self, corner: i64, canvas: &mut Canvas<'_>) {
        self.one.copy(corner, canvas);
        self.two.copy(corner, canvas);
        self.four.copy(corner, canvas);
        self.eight.copy(corner, canvas);
        self.sixteen.copy(corner, canvas);
    }
}

/// Runs of `N` to `2 N` bytes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct BlocksOf<const N: usize>(Vec<Pair<N>>);

/// The first and the last bytes of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Pair<const N: usize> {
    /// Position of the first pixel from the sprite's top left corner.
    x: u32,
    y: u32,
    /// Bytes from the start of the first block to the start of the last.
    step: u32,
    first: [u8; N],
    last: [u8; N],
}

impl<const N: usize> BlocksOf<N> {
    fn add(&mut self, x: u32, y: u32, run: &[u8]) {
        if let (Some(first), Some(last)) = (run.first_chunk(), run.last_chunk()) {
            self.0.push(Pair { x, y, step: (run.len() - N) as u32, first: *first, last: *last });
        }
    }

    #[inline]
    fn copy(&self, corner: i64, canvas: &mut Canvas<'_>) {
        let height = canvas.height() as i64;
        let pixels = canvas.pixels_mut();
        for Pair { x, y, step, first, last } in &self.0 {
            let start = (corner + i64::from(*x) * height + i64::from(*y)) as usize * 3;
            let run = &mut pixels[start..][..*step as usize + N];
            run[..N].copy_from_slice(first);
            run[*step as usize..].copy_from_slice(last);
        }
    }
}

/// The bounding rectangle of some runs.
fn bounds(runs: &[Run]) -> Rect {
    let left = runs.iter().map(|run| run.x).min().unwrap_or(0);
    let right = runs.iter().map(|run| run.x + 1).max().unwrap_or(0);
    let top = runs.iter().map(|run| run.y).min().unwrap_or(0);
    let bottom = runs.iter().map(|run| run.y + run.length).max().unwrap_or(0);
    Rect::new(left as i32, top as i32, (right - left) as i32, (bottom - top) as i32)
}
