//! Searing Spotlights: collect coins in the dark and avoid the spotlights, which are the only light.
//!
//! Behaviour of the original that looks like a bug is reproduced, since agents learn from it:
//!
//! - A spotlight at the end of its path is removed one step later, and the next one in the list then skips that step: it is
//!   neither moved nor drawn, and does no damage. Likewise, a coin that follows a collected one in the list skips that step.
//! - Spotlights of the finite id appear at a constant interval; `spawn_interval_decay` and `reward_max_steps` have no effect.
//! - An episode's first frame shows the last episode's lit circles, and the agent faces up.
//! - A background that was replaced by `hide_chessboard` or `black_background` stays replaced in later episodes of the
//!   environment.
//! - The endless id without `coin_enabled` has a black background, and hides even the spotlights for `coin_show_duration`
//!   steps.
//! - With `num_coins: [0]` the exit is open from the first step, and `coins_collected` in the info is NaN.
//! - Objects that are visible in the dark are drawn above or below the bar at the top, depending on which other objects are
//!   visible.
//!
//! Where the original raises an error, the reset parameters have their documented meaning:
//!
//! - `use_exit: false`: there is no exit, and the last coin wins the episode. If there are no coins either, the episode
//!   continues until the agent dies or `max_steps` is reached.
//! - If there are more coins than the minimum distance allows, further coins are placed without regard to earlier ones.
//! - The endless id's `show_last_action: false`: the bar does not show the action.
//! - `spot_min_radius` above `spot_max_radius`: all spotlights have the radius `spot_min_radius`.
//!
//! The number of spotlights is limited to [`MAX_SPOTLIGHTS`] and their radius to [`MAX_SPOT_RADIUS`].

mod circles;
mod config;
mod drawing;
pub mod expert;
mod features;
mod light;
mod parameters;
mod pictures;
mod position_sampler;
mod registry;
mod rules;
mod scene;
mod spotlight;
mod state;
#[cfg(test)]
mod tests;
mod top_bar;

use std::sync::Arc;

pub use config::Config;
pub use parameters::{MAX_SPOT_RADIUS, MAX_SPOTLIGHTS, Parameters, Variant};
pub use pictures::Assets;
pub use registry::IDS;
pub use scene::Scene;
pub use state::State;

use crate::shared_methods::shared_methods;
use endless_gym_core::envs::{Environment, Expert, ResetParameters};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;

/// One environment of the family.
#[derive(Clone, Debug)]
pub struct SearingSpotlights {
    assets: Arc<Assets>,
    state: State,
}

impl Environment for SearingSpotlights {
    shared_methods!(all_of_assets_and_state);

    fn new(assets: &Arc<Assets>) -> Self {
        SearingSpotlights { assets: Arc::clone(assets), state: State::new() }
    }

    fn scene(&self) -> Scene {
        Scene::new(&self.state, &self.assets.config)
    }

    fn repaint(assets: &Assets, shown: &Scene, scene: &Scene, canvas: &mut Canvas<'_>) {
        scene.repaint(shown, assets, canvas);
    }

    fn ground_truth(&self, out: &mut [f64]) {
        if self.assets.config.variant.endless {
            out.copy_from_slice(&self.state.ground_truth());
        }
    }

    fn info(&self, out: &mut [f64]) {
        let parameters = &self.assets.config.parameters;
        if self.assets.config.variant.endless {
            out.copy_from_slice(&self.state.endless_info(parameters));
        } else {
            out.copy_from_slice(&self.state.finite_info(parameters));
        }
    }

    fn expert(variant: Variant, _: &ResetParameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(expert::SpotlightsExpert::new(variant)))
    }
}
