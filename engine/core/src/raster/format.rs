//! The order of a frame's numbers in memory.

use serde::{Deserialize, Serialize};

use super::dirty_surface::DirtySurface;
use super::runs::Rgb;

/// Size of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameShape {
    /// Pixels in a row, 1 to [`MAX_SIDE`](FrameShape::MAX_SIDE).
    pub width: usize,
    /// Pixels in a column, 1 to [`MAX_SIDE`](FrameShape::MAX_SIDE).
    pub height: usize,
    /// Bytes of a pixel: 1, 3 (RGB) or 4.
    pub channels: usize,
}

impl FrameShape {
    /// Maximum width and height.
    pub const MAX_SIDE: usize = 4096;

    /// An RGB frame.
    pub const fn rgb(width: usize, height: usize) -> Self {
        FrameShape { width, height, channels: 3 }
    }

    /// Bytes of a frame that is not in grayscale.
    pub const fn bytes(self) -> usize {
        self.width * self.height * self.channels
    }

    /// Whether the numbers are within their limits.
    pub(crate) fn is_valid(self) -> bool {
        let sides = 1..=FrameShape::MAX_SIDE;
        sides.contains(&self.width) && sides.contains(&self.height) && [1, 3, 4].contains(&self.channels)
    }
}

/// Order and kind of the numbers in a frame. The default is that of a [`Canvas`](super::Canvas): \[x\]\[y\]\[channel\].
///
/// ```
/// use endless_gym_core::raster::{FrameShape, PixelFormat};
///
/// let format = PixelFormat { channels_first: true, row_major: true, ..PixelFormat::default() };
/// assert_eq!(format.shape(FrameShape::rgb(84, 84)), [3, 84, 84]);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PixelFormat {
    /// One number for each pixel, without a channel index: its luma, as Gymnasium's `GrayscaleObservation` computes it.
    pub grayscale: bool,
    /// The channel is the first index, as PyTorch's convolutions expect. No effect in grayscale.
    pub channels_first: bool,
    /// Indexed \[row\]\[column\] instead of \[x\]\[y\].
    pub row_major: bool,
}

impl PixelFormat {
    /// Shape of a frame's array.
    pub fn shape(self, FrameShape { width, height, channels }: FrameShape) -> Vec<usize> {
        let (first, second) = if self.row_major { (height, width) } else { (width, height) };
        match self {
            PixelFormat { grayscale: true, .. } => vec![first, second],
            PixelFormat { channels_first: true, .. } => vec![channels, first, second],
            _ => vec![first, second, channels],
        }
    }

    /// Whether a [`Canvas`](super::Canvas) can paint a frame in this format directly.
    pub(crate) fn is_canvas(self) -> bool {
        !self.row_major && !self.grayscale && !self.channels_first
    }

    /// The pixel (x, y) that a byte of a frame belongs to.
    pub(crate) fn pixel_of(self, byte: usize, FrameShape { width, height, channels }: FrameShape) -> (usize, usize) {
        let pixel = match self {
            PixelFormat { grayscale: true, .. } => byte,
            PixelFormat { channels_first: true, .. } => byte % (width * height),
            _ => byte / channels,
        };
        if self.row_major { (pixel % width, pixel / width) } else { (pixel / height, pixel % height) }
    }

    /// Copies the dirty pixels of `surface` into `frame`, which has the surface's size in this format.
    ///
    /// # Panics
    ///
    /// If `frame` is too short.
    pub fn store(self, surface: &DirtySurface, frame: &mut [u8]) {
        let (width, height) = (surface.width(), surface.height());
        let (across, down) = if self.row_major { (1, width) } else { (height, 1) };
        surface.for_each_run(|x, rows, run| {
            let places = rows.map(|y| x * across + y * down);
            match self {
                PixelFormat { grayscale: true, .. } => {
                    places.zip(run).for_each(|(at, color)| frame[at] = luma(*color));
                }
                PixelFormat { channels_first: true, .. } => {
                    let (red, rest) = frame.split_at_mut(width * height);
                    let (green, blue) = rest.split_at_mut(width * height);
                    for (at, color) in places.zip(run) {
                        [red[at], green[at], blue[at]] = *color;
                    }
                }
                _ => {
                    let pixels = frame.as_chunks_mut().0;
                    places.zip(run).for_each(|(at, color)| pixels[at] = *color);
                }
            }
        });
    }

    /// Copies `pixels`, in the order of a [`Canvas`](super::Canvas), into a frame in this format, which is not grayscale.
    ///
    /// # Panics
    ///
    /// If `pixels` or `frame` is too short.
    pub(crate) fn copy(self, FrameShape { width, height, channels }: FrameShape, pixels: &[u8], frame: &mut [u8]) {
        let (pixel, channel) = if self.channels_first { (1, width * height) } else { (channels, 1) };
        let (across, down) = if self.row_major { (pixel, width * pixel) } else { (height * pixel, pixel) };
        for (place, bytes) in pixels.chunks_exact(channels).enumerate() {
            let at = place / height * across + place % height * down;
            bytes.iter().enumerate().for_each(|(number, byte)| frame[at + number * channel] = *byte);
        }
    }
}

/// A colour's luma, truncated, as `GrayscaleObservation` of Gymnasium 1.x computes it.
fn luma([red, green, blue]: Rgb) -> u8 {
    (f64::from(red) * 0.2125 + f64::from(green) * 0.7154 + f64::from(blue) * 0.0721) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_format_stores_every_pixel_at_its_index() {
        let (width, height) = (3, 2);
        let mut surface = DirtySurface::new(width, height);
        let color = |x: usize, y: usize| [10 * x as u8, 10 * y as u8 + 1, 7];
        let mut canvas = surface.canvas();
        for (x, y) in (0..width).flat_map(|x| (0..height).map(move |y| (x, y))) {
            *canvas.pixel_mut(x, y) = color(x, y);
        }
        let pixels: Vec<u8> = (0..width).flat_map(|x| (0..height).flat_map(move |y| color(x, y))).collect();
        for bits in 0..8 {
            let [grayscale, channels_first, row_major] = [1, 2, 4].map(|bit| bits & bit != 0);
            let format = PixelFormat { grayscale, channels_first, row_major };
            let size = FrameShape::rgb(width, height);
            let shape = format.shape(size);
            let mut frame = vec![255; shape.iter().product()];
            format.store(&surface, &mut frame);
            if !grayscale {
                let mut copied = vec![255; frame.len()];
                format.copy(size, &pixels, &mut copied);
                assert!(copied == frame, "{format:?}");
            }
            for (x, y) in (0..width).flat_map(|x| (0..height).map(move |y| (x, y))) {
                let (first, second) = if row_major { (y, x) } else { (x, y) };
                for (channel, value) in color(x, y).into_iter().enumerate() {
                    let expected = if grayscale { luma(color(x, y)) } else { value };
                    let place = match shape[..] {
                        [_, seconds] => first * seconds + second,
                        [channels, seconds, 3] if channels == if row_major { height } else { width } => {
                            (first * seconds + second) * 3 + channel
                        }
                        [_, firsts, seconds] => (channel * firsts + first) * seconds + second,
                        _ => unreachable!("{shape:?}"),
                    };
                    assert_eq!(frame[place], expected, "{format:?} ({x}, {y})");
                    assert_eq!(format.pixel_of(place, size), (x, y), "{format:?}");
                }
            }
        }
    }

    #[test]
    fn luma_is_truncated() {
        assert_eq!([[255; 3], [255, 0, 0], [0, 255, 0], [0, 0, 255]].map(luma), [255, 54, 182, 18]);
    }
}
