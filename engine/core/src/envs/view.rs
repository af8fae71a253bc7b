//! The pictures that Gymnasium's `render` returns.
//!
//! They are indexed \[row\]\[column\]\[channel\], as in image libraries, while observations are indexed
//! \[x\]\[y\]\[channel\].

use super::environment::Environment;
use crate::raster::{Canvas, FrameShape, Rgb};

/// Scale of the ground-truth view relative to an observation.
const SCALE: usize = 4;

/// An RGB picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Pixels in a row.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// 3 bytes for each pixel, row by row.
    pub pixels: Vec<u8>,
}

impl Picture {
    /// The pixels of a canvas, each magnified to a square with side `scale`.
    fn from_columns(pixels: &[Rgb], FrameShape { width, height, .. }: FrameShape, scale: usize) -> Self {
        let stride = width * scale;
        let mut picture = vec![Rgb::default(); stride * height * scale];
        for y in 0..height {
            let row = y * scale * stride;
            for x in 0..width {
                picture[row + x * scale..][..scale].fill(pixels[x * height + y]);
            }
            (1..scale).for_each(|below| picture.copy_within(row..row + stride, row + below * stride));
        }
        Picture { width: stride, height: height * scale, pixels: picture.into_flattened() }
    }
}

/// The ground-truth view of an environment with that frame, enlarged.
pub(crate) fn ground_truth_view<E: Environment>(env: &mut E, shape: FrameShape) -> Picture {
    let mut frame = vec![0; shape.width * shape.height * 3];
    if shape.channels == 3 {
        env.draw_ground_truth(&mut Canvas::new(&mut frame, shape.width, shape.height));
        return Picture::from_columns(frame.as_chunks().0, shape, SCALE);
    }
    let mut pixels = vec![0; shape.bytes()];
    E::write_pixels(env.shared(), &env.scene(), &mut pixels);
    Picture::from_columns(&colors(&pixels, shape), shape, SCALE)
}

/// Converts a frame in the default format to Gymnasium's `render()` in the mode `rgb_array`. One channel becomes a shade of grey,
/// and a fourth one is left out.
pub fn rgb_array(frame: &[u8], shape: FrameShape) -> Picture {
    Picture::from_columns(&colors(frame, shape), shape, 1)
}

fn colors(frame: &[u8], shape: FrameShape) -> Vec<Rgb> {
    let color = |pixel: &[u8]| if let [red, green, blue, ..] = *pixel { [red, green, blue] } else { [pixel[0]; 3] };
    frame.chunks_exact(shape.channels).map(color).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_become_rows() {
        for channels in [1, 3, 4] {
            let shape = FrameShape { width: 7, height: 5, channels };
            let mut observation = vec![0; shape.bytes()];
            let (x, y) = (5, 2);
            observation[(x * 5 + y) * channels..][..channels].fill(9);
            let picture = rgb_array(&observation, shape);
            assert_eq!((picture.width, picture.height, picture.pixels.len()), (7, 5, 7 * 5 * 3));
            assert_eq!(picture.pixels.iter().position(|byte| *byte == 9), Some((y * 7 + x) * 3));
            assert_eq!(picture.pixels.iter().filter(|byte| **byte == 9).count(), 3);
        }
    }
}
