//! Converts the newest frame of an observation from any format to RGB rows.

use endless_gym_core::batch::Frames;
use endless_gym_core::raster::FrameShape;

use super::picture::Pixels;

/// The newest frame of one environment's observation in that format. Missing bytes are black.
pub fn newest(observation: &[u8], frames: Frames, shape: FrameShape) -> Pixels {
    let format = frames.format;
    let FrameShape { width, height, channels } = shape;
    let channels = if format.grayscale { 1 } else { channels };
    let bytes = width * height * channels;
    let frame = observation.get((frames.stack - 1) * bytes..).unwrap_or_default();
    let byte = |at: usize| frame.get(at).copied().unwrap_or_default();
    Pixels::framed(width, height, |x, y| {
        let at = if format.row_major { y * width + x } else { x * height + y };
        // One channel is a shade of grey, and a fourth one is not shown.
        std::array::from_fn(|color| {
            let channel = if channels == 1 { 0 } else { color };
            byte(if format.channels_first { channel * width * height + at } else { at * channels + channel })
        })
    })
}

#[cfg(test)]
mod tests {
    use endless_gym_core::batch::{Batch, zeroed};
    use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
    use endless_gym_core::raster::PixelFormat;
    use endless_gym_memory_gym::{FRAME, memory_gym};

    use super::*;

    fn observed(frames: Frames) -> Pixels {
        let config = PoolConfig::new("SearingSpotlights-v0", 1).frames(Some(frames));
        let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).unwrap();
        let mut blocks = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::Seed(2), &mut blocks).unwrap();
        for _ in 0..5 {
            pool.step(&[1, 2], &mut blocks).unwrap();
        }
        newest(Batch::new(pool.layout(), &blocks).observation(), frames, FRAME)
    }

    #[test]
    fn every_format_shows_the_same_frame() {
        let format = |grayscale, channels_first, row_major| PixelFormat { grayscale, channels_first, row_major };
        let plain = observed(Frames { format: format(false, false, true), stack: 1 });
        assert!(plain.pixels.iter().any(|[r, g, b]| r != g || g != b));
        for stack in [1, 3] {
            for (channels_first, row_major) in [(false, false), (false, true), (true, false), (true, true)] {
                let other = observed(Frames { format: format(false, channels_first, row_major), stack });
                assert!(other.pixels == plain.pixels, "{stack} {channels_first} {row_major}");
            }
            let luma =
                [false, true].map(|row_major| observed(Frames { format: format(true, false, row_major), stack }));
            assert!(luma[0].pixels == luma[1].pixels && luma[0].pixels.iter().all(|[r, g, b]| r == g && g == b));
        }
    }
}
