//! How the pixels of a finished picture may lie in memory.

use serde::{Deserialize, Serialize};

use super::{Rgb, Sketch};

/// Order and kind of the numbers in a picture. The default is a canvas' own: \[x\]\[y\]\[channel\], as the original's
/// observations are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PixelFormat {
    /// One number a pixel, without an index for the channel: its brightness, as Gymnasium's `GrayscaleObservation` has it.
    pub grayscale: bool,
    /// The channel is the first index, as PyTorch's convolutions want it.
    pub channels_first: bool,
    /// \[row\]\[column\] instead of \[x\]\[y\].
    pub row_major: bool,
}

impl PixelFormat {
    /// Shape of a picture's array.
    pub fn shape(self, width: usize, height: usize) -> Vec<usize> {
        let (first, second) = if self.row_major { (height, width) } else { (width, height) };
        match self {
            PixelFormat { grayscale: true, .. } => vec![first, second],
            PixelFormat { channels_first: true, .. } => vec![3, first, second],
            _ => vec![first, second, 3],
        }
    }

    /// Whether a canvas can be painted on the picture itself.
    pub fn is_canvas(self) -> bool {
        !self.row_major && !self.grayscale && !self.channels_first
    }

    /// The pixel (x, y) that a byte of a picture belongs to.
    pub fn place(self, byte: usize, width: usize, height: usize) -> (usize, usize) {
        let pixel = match self {
            PixelFormat { grayscale: true, .. } => byte,
            PixelFormat { channels_first: true, .. } => byte % (width * height),
            _ => byte / 3,
        };
        if self.row_major { (pixel % width, pixel / width) } else { (pixel / height, pixel % height) }
    }

    /// Writes the pixels that were painted on a sketch to their places in `picture`.
    pub fn store(self, sketch: &Sketch, picture: &mut [u8]) {
        let (width, height) = (sketch.width(), sketch.height());
        let (across, down) = if self.row_major { (1, width) } else { (height, 1) };
        sketch.for_each_run(|x, rows, run| {
            let places = rows.map(|y| x * across + y * down);
            match self {
                PixelFormat { grayscale: true, .. } => {
                    places.zip(run).for_each(|(at, color)| picture[at] = brightness(*color));
                }
                PixelFormat { channels_first: true, .. } => {
                    let (red, rest) = picture.split_at_mut(width * height);
                    let (green, blue) = rest.split_at_mut(width * height);
                    for (at, color) in places.zip(run) {
                        [red[at], green[at], blue[at]] = *color;
                    }
                }
                _ => {
                    let pixels = picture.as_chunks_mut().0;
                    places.zip(run).for_each(|(at, color)| pixels[at] = *color);
                }
            }
        });
    }
}

/// A colour's brightness, cut off as Gymnasium does.
fn brightness([red, green, blue]: Rgb) -> u8 {
    (f64::from(red) * 0.2125 + f64::from(green) * 0.7154 + f64::from(blue) * 0.0721) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_format_has_every_pixel_in_its_place() {
        let (width, height) = (3, 2);
        let mut sketch = Sketch::new(width, height);
        let color = |x: usize, y: usize| [10 * x as u8, 10 * y as u8 + 1, 7];
        let mut canvas = sketch.canvas();
        for (x, y) in (0..width).flat_map(|x| (0..height).map(move |y| (x, y))) {
            *canvas.pixel_mut(x, y) = color(x, y);
        }
        for bits in 0..8 {
            let [grayscale, channels_first, row_major] = [1, 2, 4].map(|bit| bits & bit != 0);
            let format = PixelFormat { grayscale, channels_first, row_major };
            let shape = format.shape(width, height);
            let mut picture = vec![255; shape.iter().product()];
            format.store(&sketch, &mut picture);
            for (x, y) in (0..width).flat_map(|x| (0..height).map(move |y| (x, y))) {
                let (first, second) = if row_major { (y, x) } else { (x, y) };
                for (channel, value) in color(x, y).into_iter().enumerate() {
                    let expected = if grayscale { brightness(color(x, y)) } else { value };
                    let place = match shape[..] {
                        [_, seconds] => first * seconds + second,
                        [channels, seconds, 3] if channels == if row_major { height } else { width } => {
                            (first * seconds + second) * 3 + channel
                        }
                        [_, firsts, seconds] => (channel * firsts + first) * seconds + second,
                        _ => unreachable!("{shape:?}"),
                    };
                    assert_eq!(picture[place], expected, "{format:?} ({x}, {y})");
                    assert_eq!(format.place(place, width, height), (x, y), "{format:?}");
                }
            }
        }
    }

    #[test]
    fn brightness_is_cut_off() {
        assert_eq!([[255; 3], [255, 0, 0], [0, 255, 0], [0, 0, 255]].map(brightness), [255, 54, 182, 18]);
    }
}
