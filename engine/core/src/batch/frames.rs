//! What the frames of an observation look like.

use serde::{Deserialize, Serialize};

use crate::envs::SCREEN;
use crate::raster::PixelFormat;

/// Most frames in an observation.
pub const MAX_STACK: usize = 64;

/// The frames of an observation. The default is the original's: one, uint8 (84, 84, 3), indexed \[x\]\[y\]\[channel\].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Frames {
    /// How the pixels of each frame lie.
    pub format: PixelFormat,
    /// The last frames of the episode that are in an observation, oldest first, 1 to [`MAX_STACK`]; an episode's first frame
    /// stands for those before it. With more than 1 they are the first index, as in Gymnasium's `FrameStackObservation`.
    pub stack: usize,
}

impl Default for Frames {
    fn default() -> Self {
        Frames { format: PixelFormat::default(), stack: 1 }
    }
}

impl Frames {
    /// Shape of one environment's observation.
    pub fn shape(self) -> Vec<usize> {
        let frame = self.format.shape(SCREEN, SCREEN);
        if self.stack == 1 { frame } else { [vec![self.stack], frame].concat() }
    }
}
