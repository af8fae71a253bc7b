//! Size and memory layout of an observation.

/// Width and height of an observation in pixels.
pub const SCREEN: usize = 84;

/// Bytes of one observation: 84x84 RGB, indexed \[x\]\[y\]\[channel\].
pub const FRAME_BYTES: usize = SCREEN * SCREEN * 3;

/// The pixels of one observation.
pub type Frame = [u8; FRAME_BYTES];
