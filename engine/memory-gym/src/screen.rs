//! Size and memory layout of an observation, and the specification of ids that have it.

use endless_gym_core::envs::{ActionBranch, ActionSpace, EnvSpec};
use endless_gym_core::raster::FrameShape;

/// Width and height of an observation in pixels.
pub const SCREEN: usize = 84;

/// The frame of every environment.
pub const FRAME: FrameShape = FrameShape::rgb(SCREEN, SCREEN);

/// The pixels of one observation: RGB, indexed \[x\]\[y\]\[channel\].
pub type Frame = [u8; FRAME.bytes()];

/// The specification of an id, without what the families differ in.
pub const fn spec(
    id: &'static str,
    summary: &'static str,
    action_space: ActionSpace,
    actions: &'static [ActionBranch],
) -> EnvSpec {
    let mut spec = EnvSpec::new(id, summary, action_space);
    spec.actions = actions;
    spec.frame = Some(FRAME);
    spec.ground_truth_bounds = Some((0.0, 1.0));
    spec
}
