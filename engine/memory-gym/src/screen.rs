//! Size and memory layout of an observation.

use endless_gym_core::raster::FrameShape;

/// Width and height of an observation in pixels.
pub const SCREEN: usize = 84;

/// The frame of every environment.
pub const FRAME: FrameShape = FrameShape::rgb(SCREEN, SCREEN);

/// The pixels of one observation: RGB, indexed \[x\]\[y\]\[channel\].
pub type Frame = [u8; FRAME.bytes()];
