//! A surface with dirty tracking.

use std::ops::Range;

use super::canvas::Canvas;
use super::runs::Rgb;

/// Pixels with a dirty mask, so that only painted pixels need to be copied.
///
/// The colours of pixels that were not painted since the last call of [`canvas`](DirtySurface::canvas) are unspecified.
#[derive(Clone, Debug)]
pub struct DirtySurface {
    pixels: Vec<u8>,
    width: usize,
    height: usize,
    /// For each column, a mask with a bit for each row.
    dirty: Vec<u128>,
}

impl DirtySurface {
    /// Maximum height of a surface with a dirty mask.
    pub const MAX_HEIGHT: usize = u128::BITS as usize;

    /// A surface with no dirty pixel. Above [`MAX_HEIGHT`](DirtySurface::MAX_HEIGHT) it has no mask, and all pixels count as dirty.
    pub fn new(width: usize, height: usize) -> Self {
        DirtySurface { pixels: vec![0; width * height * 3], width, height, dirty: vec![0; width] }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Clears the dirty mask and returns a canvas that marks painted pixels.
    pub fn canvas(&mut self) -> Canvas<'_> {
        let canvas = Canvas::new(&mut self.pixels, self.width, self.height);
        if self.height > DirtySurface::MAX_HEIGHT {
            return canvas;
        }
        self.dirty.fill(0);
        canvas.tracking_dirty(&mut self.dirty)
    }

    /// Calls `run` for each run of dirty pixels with its column, its rows, and its pixels.
    pub fn for_each_run(&self, mut run: impl FnMut(usize, Range<usize>, &[Rgb])) {
        let columns = self.pixels.as_chunks::<3>().0.chunks_exact(self.height.max(1));
        if self.height > DirtySurface::MAX_HEIGHT {
            return columns.enumerate().for_each(|(x, column)| run(x, 0..self.height, column));
        }
        for (x, (bits, column)) in self.dirty.iter().zip(columns).enumerate() {
            let mut rest = *bits;
            while rest != 0 {
                let start = rest.trailing_zeros() as usize;
                let end = start + (rest >> start).trailing_ones() as usize;
                run(x, start..end, &column[start..end]);
                rest &= u128::MAX.checked_shl(end as u32).unwrap_or(0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::{Rect, Sprite, Surface};

    /// All painted pixels.
    fn painted(surface: &DirtySurface) -> Vec<(usize, usize)> {
        let mut painted = Vec::new();
        surface.for_each_run(|x, rows, _| painted.extend(rows.map(|y| (x, y))));
        painted
    }

    #[test]
    fn only_painted_pixels_are_dirty() {
        let mut surface = DirtySurface::new(5, 128);
        let mut canvas = surface.canvas();
        *canvas.pixel_mut(1, 127) = [1, 2, 3];
        canvas.draw_rect([9; 3], Rect::new(3, 0, 9, 2), 0);
        canvas.clipped(Rect::new(0, 126, 1, 9)).fill([7; 3]);
        assert_eq!(painted(&surface), [(0, 126), (0, 127), (1, 127), (3, 0), (3, 1), (4, 0), (4, 1)]);
        let mut colors = Vec::new();
        surface.for_each_run(|_, _, run| colors.extend_from_slice(run));
        assert_eq!(colors, [[7; 3], [7; 3], [1, 2, 3], [9; 3], [9; 3], [9; 3], [9; 3]]);
        surface.canvas().fill([0; 3]);
        assert_eq!(painted(&surface).len(), 5 * 128);
        surface.canvas();
        assert_eq!(painted(&surface), []);
    }

    #[test]
    fn every_drawing_operation_marks_its_pixels() {
        let mut source = Surface::new(7, 9);
        source.fill([0, 0, 255]);
        source.draw_circle([200, 100, 0], (4, 4), 3, 0);
        source.set_color_key(Some([0, 0, 255]));
        let sprite = Sprite::new(&source);
        let disc = crate::raster::Disc::new(4);
        let picture = vec![55; 20 * 30 * 3];
        type Paint<'a> = &'a dyn Fn(&mut Canvas<'_>);
        let ways: [Paint<'_>; 12] = [
            &|canvas| canvas.fill([1, 2, 3]),
            &|canvas| canvas.clipped(Rect::new(3, 4, 5, 6)).fill([1, 2, 3]),
            &|canvas| canvas.paste(&picture),
            &|canvas| canvas.clipped(Rect::new(3, 4, 5, 6)).paste(&picture),
            &|canvas| canvas.blit(&source, 3, 25),
            &|canvas| sprite.blit(canvas, 5, 6),
            &|canvas| sprite.blit(canvas, -3, 26),
            &|canvas| sprite.blit_within(canvas, 5, 6, &disc, (8, 9)),
            &|canvas| sprite.shaded(100).blit(canvas, 15, -2),
            &|canvas| canvas.fill_disc([4, 5, 6], (2, 3), &disc),
            &|canvas| canvas.draw_circle([4, 5, 6], (10, 12), 9, 3),
            &|canvas| canvas.draw_line([4, 5, 6], (-2, 3), (30, 20), 3),
        ];
        for (number, paint) in ways.iter().enumerate() {
            let mut expected = DirtySurface::new(20, 30);
            paint(&mut Canvas::new(&mut expected.pixels, 20, 30));
            let mut surface = DirtySurface::new(20, 30);
            paint(&mut surface.canvas());
            let mut found = vec![0; surface.pixels.len()];
            surface.for_each_run(|x, rows, run| {
                found[(x * 30 + rows.start) * 3..][..run.len() * 3].copy_from_slice(run.as_flattened());
            });
            assert!(found.iter().any(|byte| *byte != 0), "way {number} paints nothing");
            assert!(found == expected.pixels, "way {number}");
        }
    }
}
