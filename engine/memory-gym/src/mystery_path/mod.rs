//! Mystery Path: find an invisible path, and remember it after each fall.
//!
//! In the finite ids the agent crosses the screen from one side to the goal on the other. An agent that steps off the path
//! starts over. The endless id joins path after path to the right. Its episode ends when the agent falls off in a column before
//! the farthest one that it was on, falls twice at the same tile, or runs out of stamina.
//!
//! Options with which the original raises an error, or that have no effect:
//!
//! - `stamina_level` below 1 makes the original divide by zero, or the stamina never runs out; here it is at least 1.
//! - `agent_speed` above the screen's width moves the original's agent beyond the generated path; here it is at most that
//!   width.
//! - `show_origin` of the endless id and `agent_scale` of the grid id have no effect, as in the original.

mod belief;
mod config;
mod drawing;
mod endless;
pub mod expert;
mod features;
mod parameters;
mod path;
mod registry;
mod route;
mod rules;
mod scene;
mod state;

#[cfg(test)]
mod tests;

use std::sync::Arc;

pub use config::Config;
pub use drawing::Assets;
pub use endless::Direction;
pub use parameters::{Parameters, Variant};
pub use registry::IDS;
pub use scene::Scene;
pub use state::State;

use crate::shared_methods::shared_methods;
use endless_gym_core::envs::{Environment, Expert, ResetParameters};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;

/// One environment of the family.
#[derive(Clone, Debug)]
pub struct MysteryPath {
    assets: Arc<Assets>,
    state: State,
}

impl Environment for MysteryPath {
    shared_methods!(all_of_assets_and_state);

    fn new(assets: &Arc<Assets>) -> Self {
        MysteryPath { assets: Arc::clone(assets), state: State::default() }
    }

    fn scene(&self) -> Scene {
        self.state.scene(&self.assets.config)
    }

    fn repaint(assets: &Assets, shown: &Scene, scene: &Scene, canvas: &mut Canvas<'_>) {
        scene.damage_since(shown, assets).repair(canvas, |canvas| scene.paint(assets, canvas));
    }

    fn ground_truth(&self, out: &mut [f64]) {
        out.fill(0.0);
        if self.assets.config.variant == Variant::Endless {
            out[self.state.endless.direction as usize] = 1.0;
        }
    }

    fn info(&self, out: &mut [f64]) {
        match self.assets.config.variant {
            Variant::Free | Variant::Grid => {
                out.copy_from_slice(&self.state.finite_info(&self.assets.config.parameters));
            }
            Variant::Endless => out.copy_from_slice(&self.state.endless_info()),
        }
    }

    fn expert(variant: Variant, _: &ResetParameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(expert::PathExpert::new(variant)))
    }
}
