//! Painting one surface onto another: opaque, with a colour key, or translucent.

use super::canvas::Canvas;
use super::runs::{Rgb, clip};
use super::surface::Surface;

/// Blends a channel of a colour-keyed translucent surface into the channel below it, as SDL 2.26 does: the change is `1/255` of
/// the difference per unit of `alpha`, truncated towards zero.
#[inline]
pub const fn blend_keyed(source: u8, below: u8, alpha: u8) -> u8 {
    let weighted = source.abs_diff(below) as u16 * alpha as u16;
    // The quotient by 255, exact for all products of two bytes.
    let change = ((weighted + 1 + (weighted >> 8)) >> 8) as u8;
    if source >= below { below + change } else { below - change }
}

/// Blends a channel of a translucent surface without a colour key into the channel below it, as SDL 2.26 does: the change is
/// `1/256` of the difference per unit of `alpha`, rounded down, but an `alpha` of 255 is opaque.
#[inline]
const fn blend_plain(source: u8, below: u8, alpha: u8) -> u8 {
    if alpha == 255 {
        return source;
    }
    ((source as u16 * alpha as u16 + below as u16 * (256 - alpha as u16)) >> 8) as u8
}

/// The blending rule of a surface.
#[derive(Clone, Copy)]
enum Blending {
    Opaque,
    Keyed,
    Plain,
}

impl Blending {
    fn of(source: &Surface) -> Self {
        if source.alpha() == 255 {
            Self::Opaque
        } else if source.color_key().is_some() && !source.run_length_encoded {
            Self::Keyed
        } else {
            // SDL blends run-length encoded surfaces like those without a key.
            Self::Plain
        }
    }

    fn paint(self, source: &[u8], below: &mut [u8], alpha: u8) {
        match self {
            Self::Opaque => below.copy_from_slice(source),
            Self::Keyed => {
                for (source, below) in source.iter().zip(below) {
                    *below = blend_keyed(*source, *below, alpha);
                }
            }
            Self::Plain => {
                for (source, below) in source.iter().zip(below) {
                    *below = blend_plain(*source, *below, alpha);
                }
            }
        }
    }
}

impl Canvas<'_> {
    /// Paints `source` with its top left corner at `(x, y)`, as `pygame.Surface.blit` does: without the pixels of its colour
    /// key, and blended by its alpha.
    pub fn blit(&mut self, source: &Surface, x: i32, y: i32) {
        let (x, y) = (i64::from(x), i64::from(y));
        let columns = clip(x, x + source.width() as i64 - 1, &self.columns());
        let rows = clip(y, y + source.height() as i64 - 1, &self.rows());
        if columns.is_empty() || rows.is_empty() || source.alpha() == 0 {
            return;
        }
        let blending = Blending::of(source);
        for column in columns {
            let first = (column as i64 - x) as usize * source.height() + (rows.start as i64 - y) as usize;
            let run = &source.pixels().as_chunks::<3>().0[first..][..rows.len()];
            for (first, opaque) in opaque_runs(run, source.color_key()) {
                let row = rows.start + first;
                let below = self.run_mut(column, row..row + opaque.len());
                blending.paint(opaque.as_flattened(), below, source.alpha());
            }
        }
    }
}

/// The parts of a run between the pixels of the colour key, each with the index of its first pixel.
pub(super) fn opaque_runs(run: &[Rgb], key: Option<Rgb>) -> impl Iterator<Item = (usize, &[Rgb])> {
    let mut next = 0;
    // Without a key, nothing needs to be compared.
    let is_same = move |a: &Rgb, b: &Rgb| key.is_none_or(|key| (*a == key) == (*b == key));
    run.chunk_by(is_same).filter_map(move |part| {
        let first = next;
        next += part.len();
        (Some(part[0]) != key).then_some((first, part))
    })
}
