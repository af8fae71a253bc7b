//! The format of the frames of an observation.

use serde::{Deserialize, Serialize};

use crate::raster::{FrameShape, PixelFormat};

/// Maximum number of frames in an observation.
pub const MAX_STACK: usize = 64;

/// Format of an observation's frames. The default is one frame, uint8, indexed \[x\]\[y\]\[channel\].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Frames {
    /// Order of the numbers within a frame.
    pub format: PixelFormat,
    /// Number of frames in an observation, 1 to [`MAX_STACK`]: the last frames of the episode, oldest first. At the start of an
    /// episode its first frame is repeated. With more than 1, the frame is the first index, as in Gymnasium's
    /// `FrameStackObservation`.
    pub stack: usize,
}

impl Default for Frames {
    fn default() -> Self {
        Frames { format: PixelFormat::default(), stack: 1 }
    }
}

impl Frames {
    /// Shape of one environment's observation.
    ///
    /// ```
    /// use endless_gym_core::batch::Frames;
    /// use endless_gym_core::raster::FrameShape;
    ///
    /// let frame = FrameShape::rgb(84, 84);
    /// assert_eq!(Frames::default().shape(frame), [84, 84, 3]);
    /// assert_eq!(Frames { stack: 4, ..Frames::default() }.shape(frame), [4, 84, 84, 3]);
    /// ```
    pub fn shape(self, frame: FrameShape) -> Vec<usize> {
        let frame = self.format.shape(frame);
        if self.stack == 1 { frame } else { [vec![self.stack], frame].concat() }
    }
}
