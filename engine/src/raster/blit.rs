//! Painting one surface onto another: copied, with a colour key, and translucent.

use super::canvas::clip;
use super::{Canvas, Rgb, Surface};

/// Mixes a channel of a colour-keyed translucent surface into the channel below it, as SDL 2.26
/// does: the change is `1/255` of the difference per unit of `alpha`, cut off towards zero.
#[inline]
pub const fn blend_keyed(source: u8, below: u8, alpha: u8) -> u8 {
    let difference = source as i32 - below as i32;
    (below as i32 + difference * alpha as i32 / 255) as u8
}

/// Mixes a channel of a translucent surface without a colour key into the channel below it, as SDL
/// 2.26 does: the change is `1/256` of the difference per unit of `alpha`, rounded down, but an
/// `alpha` of 255 covers fully.
#[inline]
pub const fn blend_plain(source: u8, below: u8, alpha: u8) -> u8 {
    if alpha == 255 {
        return source;
    }
    let difference = source as i32 - below as i32;
    (below as i32 + ((difference * alpha as i32) >> 8)) as u8
}

impl Canvas<'_> {
    /// Paints `source` with its top left corner at `(x, y)`, as `pygame.Surface.blit` does: without
    /// the pixels of its colour key, and as translucent as its alpha says.
    pub fn blit(&mut self, source: &Surface, x: i32, y: i32) {
        let (x, y) = (i64::from(x), i64::from(y));
        let columns = clip(x, x + source.width() as i64 - 1, self.width());
        let rows = clip(y, y + source.height() as i64 - 1, self.height());
        if columns.is_empty() || rows.is_empty() || source.alpha() == 0 {
            return;
        }
        let height = self.height();
        let first_row = (rows.start as i64 - y) as usize;
        for column in columns {
            let source_start = (column as i64 - x) as usize * source.height() + first_row;
            let run = &source.pixels().as_chunks().0[source_start..source_start + rows.len()];
            let start = column * height + rows.start;
            let below = &mut self.pixels_mut().as_chunks_mut().0[start..start + rows.len()];
            blit_run(run, below, source);
        }
    }
}

/// Paints a run of pixels of the surface `source` over the ones `below`.
fn blit_run(run: &[Rgb], below: &mut [Rgb], source: &Surface) {
    let alpha = source.alpha();
    match (source.color_key(), alpha) {
        (None, 255) => below.copy_from_slice(run),
        (None, _) => {
            for (pixel, below) in run.iter().zip(below) {
                *below = mixed(*pixel, *below, |source, below| blend_plain(source, below, alpha));
            }
        }
        (Some(key), 255) => {
            for (pixel, below) in run.iter().zip(below).filter(|(pixel, _)| **pixel != key) {
                *below = *pixel;
            }
        }
        (Some(key), _) => {
            // SDL blends run-length encoded surfaces by the rule of those without a key.
            let blend = if source.run_length_encoded { blend_plain } else { blend_keyed };
            for (pixel, below) in run.iter().zip(below).filter(|(pixel, _)| **pixel != key) {
                *below = mixed(*pixel, *below, |source, below| blend(source, below, alpha));
            }
        }
    }
}

#[inline]
fn mixed(pixel: Rgb, below: Rgb, blend: impl Fn(u8, u8) -> u8) -> Rgb {
    std::array::from_fn(|channel| blend(pixel[channel], below[channel]))
}
