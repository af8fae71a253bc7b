//! Converts frames to the format of a browser's canvas: RGBA, \[row\]\[column\].

use endless_gym_core::envs::view::Picture;
use endless_gym_memory_gym::SCREEN;

/// Bytes of a frame.
pub const RGBA_BYTES: usize = SCREEN * SCREEN * 4;

/// Writes an observation, indexed \[x\]\[y\]\[channel\], to the start of `out`, whose rows are `stride` pixels long.
pub fn put_observation(observation: &[u8], out: &mut [u8], stride: usize) {
    let (pixels, out) = (observation.as_chunks::<3>().0, out.as_chunks_mut::<4>().0);
    for y in 0..SCREEN {
        let row = &mut out[y * stride..][..SCREEN];
        for (to, [red, green, blue]) in row.iter_mut().zip(pixels[y..].iter().step_by(SCREEN)) {
            *to = [*red, *green, *blue, 255];
        }
    }
}

/// Writes a magnified ground-truth view, indexed \[row\]\[column\]\[channel\], reduced to the frame's size.
pub fn put_view(view: &Picture, out: &mut [u8]) {
    let scale = view.width / SCREEN;
    let (pixels, out) = (view.pixels.as_chunks::<3>().0, out.as_chunks_mut::<4>().0);
    for (row, to) in out.chunks_exact_mut(SCREEN).enumerate() {
        for (to, [red, green, blue]) in to.iter_mut().zip(pixels[row * scale * view.width..].iter().step_by(scale)) {
            *to = [*red, *green, *blue, 255];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use endless_gym_memory_gym::FRAME;

    #[test]
    fn pictures_are_not_transposed() {
        let (x, y) = (5, 70);
        let mut observation = [0; FRAME.bytes()];
        observation[(x * SCREEN + y) * 3 + 1] = 9;
        let side = 4 * SCREEN;
        let mut view = Picture { width: side, height: side, pixels: vec![0; side * side * 3] };
        view.pixels[(y * 4 * side + x * 4) * 3 + 1] = 9;
        let mut wide = vec![0; SCREEN * (SCREEN + 3) * 4];
        put_observation(&observation, &mut wide, SCREEN + 3);
        assert_eq!(wide[(y * (SCREEN + 3) + x) * 4..][..4], [0, 9, 0, 255]);
        let mut square = vec![0; RGBA_BYTES];
        put_view(&view, &mut square);
        assert_eq!(square[(y * SCREEN + x) * 4..][..4], [0, 9, 0, 255]);
        assert_eq!(square.iter().filter(|byte| **byte == 9).count(), 1);
    }
}
