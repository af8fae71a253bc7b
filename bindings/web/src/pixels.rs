//! Converts frames to the format of a browser's canvas: RGBA, \[row\]\[column\].

use endless_gym_core::envs::view::Picture;
use endless_gym_core::raster::FrameShape;

/// Writes an observation, indexed \[x\]\[y\]\[channel\], to the start of `out`, whose rows are `stride` pixels long. One channel
/// becomes a shade of grey, and a fourth one is left out.
pub fn put_observation(observation: &[u8], shape: FrameShape, out: &mut [u8], stride: usize) {
    let FrameShape { width, height, channels } = shape;
    let out = out.as_chunks_mut::<4>().0;
    for y in 0..height {
        let pixels = observation[y * channels..].chunks(channels).step_by(height);
        for (to, pixel) in out[y * stride..][..width].iter_mut().zip(pixels) {
            let [red, green, blue] =
                if let [red, green, blue, ..] = *pixel { [red, green, blue] } else { [pixel[0]; 3] };
            *to = [red, green, blue, 255];
        }
    }
}

/// Writes a magnified ground-truth view, indexed \[row\]\[column\]\[channel\], reduced to the frame's size.
pub fn put_view(view: &Picture, FrameShape { width, .. }: FrameShape, out: &mut [u8]) {
    let scale = view.width / width;
    let (pixels, out) = (view.pixels.as_chunks::<3>().0, out.as_chunks_mut::<4>().0);
    for (row, to) in out.chunks_exact_mut(width).enumerate() {
        for (to, [red, green, blue]) in to.iter_mut().zip(pixels[row * scale * view.width..].iter().step_by(scale)) {
            *to = [*red, *green, *blue, 255];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_not_transposed() {
        for channels in [1, 3, 4] {
            let shape = FrameShape { width: 7, height: 5, channels };
            let (x, y) = (5, 2);
            let mut observation = vec![0; shape.bytes()];
            observation[(x * 5 + y) * channels..][..channels].copy_from_slice(&[7, 8, 9, 6][..channels]);
            let mut wide = vec![0; 5 * 10 * 4];
            put_observation(&observation, shape, &mut wide, 10);
            let expected = if channels == 1 { [7, 7, 7, 255] } else { [7, 8, 9, 255] };
            assert_eq!(wide[(y * 10 + x) * 4..][..4], expected);
            assert_eq!(wide.iter().filter(|byte| (6..10).contains(*byte)).count(), 3);
        }
        let shape = FrameShape::rgb(7, 5);
        let mut view = Picture { width: 28, height: 20, pixels: vec![0; 28 * 20 * 3] };
        let (x, y) = (5, 2);
        view.pixels[(y * 4 * 28 + x * 4) * 3 + 1] = 9;
        let mut small = vec![0; 7 * 5 * 4];
        put_view(&view, shape, &mut small);
        assert_eq!(small[(y * 7 + x) * 4..][..4], [0, 9, 0, 255]);
        assert_eq!(small.iter().filter(|byte| **byte == 9).count(), 1);
    }
}
