//! The pictures that the original's `render` returns.
//!
//! They are indexed \[row\]\[column\]\[channel\], as in image libraries, whereas observations are indexed
//! \[x\]\[y\]\[channel\].

use super::environment::Environment;
use super::screen::{FRAME_BYTES, SCREEN};
use crate::raster::Canvas;

/// Scale of the ground-truth view relative to an observation.
const SCALE: usize = 4;

/// Width and height of the ground-truth view in pixels.
pub const VIEW: usize = SCREEN * SCALE;

/// Bytes of the ground-truth view: 336x336 RGB.
pub const VIEW_BYTES: usize = VIEW * VIEW * 3;

/// Draws the ground-truth view, the original's `render()` in the mode `debug_rgb_array`, into the first [`VIEW_BYTES`]
/// bytes of `out`.
///
/// # Panics
///
/// If `out` is shorter.
pub fn ground_truth_view<E: Environment>(env: &mut E, out: &mut [u8]) {
    let mut frame = [0; FRAME_BYTES];
    env.draw_ground_truth(&mut Canvas::new(&mut frame, SCREEN, SCREEN));
    let pixels = frame.as_chunks::<3>().0;
    for (row, line) in out[..VIEW_BYTES].chunks_exact_mut(VIEW * 3).enumerate() {
        for (x, magnified) in line.as_chunks_mut::<3>().0.as_chunks_mut::<SCALE>().0.iter_mut().enumerate() {
            magnified.fill(pixels[x * SCREEN + row / SCALE]);
        }
    }
}

/// Converts an observation to the original's `render()` in the mode `rgb_array`. Both have [`FRAME_BYTES`] bytes.
///
/// # Panics
///
/// If one of them is shorter.
pub fn rgb_array(observation: &[u8], out: &mut [u8]) {
    let pixels = observation[..FRAME_BYTES].as_chunks::<3>().0;
    for (index, pixel) in out[..FRAME_BYTES].as_chunks_mut::<3>().0.iter_mut().enumerate() {
        *pixel = pixels[index % SCREEN * SCREEN + index / SCREEN];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_become_rows() {
        let mut observation = [0; FRAME_BYTES];
        let (x, y) = (5, 70);
        observation[(x * SCREEN + y) * 3 + 1] = 9;
        let mut picture = [1; FRAME_BYTES];
        rgb_array(&observation, &mut picture);
        assert_eq!(picture.iter().position(|byte| *byte == 9), Some((y * SCREEN + x) * 3 + 1));
        assert_eq!(picture.iter().filter(|byte| **byte == 0).count(), FRAME_BYTES - 1);
    }
}
