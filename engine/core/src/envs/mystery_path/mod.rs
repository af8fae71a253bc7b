//! Mystery Path: find an invisible path, and remember it after each fall.
//!
//! In the finite ids the agent crosses the screen from one side to the goal on the other. Whoever steps off the path starts over.
//! In the endless id path after path leads to the right; an episode ends when the agent falls off before the farthest column that
//! it was on, falls twice at one place, or runs out of stamina.
//!
//! Where the original fails or its option has no effect:
//!
//! - `stamina_level` below 1 makes it divide by zero or never ends; here it is at least 1.
//! - `agent_speed` above the screen's width leads it beyond the path that it has generated; here it is at most that width.
//! - `show_origin` of the endless id has no effect, and so it is here; the observations have to be equal.
//! - `agent_scale` of the grid id has no effect either.

mod belief;
mod drawing;
pub mod expert;
mod features;
mod journey;
mod parameters;
mod path;
mod route;
mod rules;

#[cfg(test)]
mod tests;

use std::sync::Arc;

pub use drawing::{Assets, Scene};
pub use journey::Direction;
pub use parameters::{Parameters, SPECS, Variant};
pub use rules::State;

use crate::envs::{Environment, InvalidState, ResetParameters, Transition};
use crate::random::Generator;
use crate::raster::Canvas;

/// One environment of the family.
#[derive(Clone, Debug)]
pub struct MysteryPath {
    assets: Arc<Assets>,
    state: State,
}

impl Environment for MysteryPath {
    type Variant = Variant;
    type Assets = Assets;
    type State = State;
    type Scene = Scene;

    fn assets(variant: Variant, parameters: &ResetParameters) -> Assets {
        Assets::new(variant, Parameters::new(variant, parameters))
    }

    fn new(assets: &Arc<Assets>) -> Self {
        MysteryPath { assets: Arc::clone(assets), state: State::default() }
    }

    fn reset(&mut self, assets: &Arc<Assets>, random: &mut Generator) {
        if !Arc::ptr_eq(&self.assets, assets) {
            self.assets = Arc::clone(assets);
        }
        self.state.start(assets, random);
    }

    fn step(&mut self, action: &[i32], random: &mut Generator) -> Transition {
        self.state.play(&self.assets, action, random)
    }

    fn shared(&self) -> &Arc<Assets> {
        &self.assets
    }

    fn scene(&self) -> Scene {
        self.state.scene(&self.assets)
    }

    fn paint(assets: &Assets, scene: &Scene, canvas: &mut Canvas<'_>) {
        scene.paint(assets, canvas);
    }

    fn repaint(assets: &Assets, shown: &Scene, scene: &Scene, canvas: &mut Canvas<'_>) {
        scene.damage_since(shown, assets).repair(canvas, |canvas| scene.paint(assets, canvas));
    }

    fn draw_ground_truth(&mut self, canvas: &mut Canvas<'_>) {
        self.state.draw_truth(&self.assets, canvas);
    }

    fn features(&self, out: &mut [f32]) {
        self.state.write_features(&self.assets, out);
    }

    fn ground_truth(&self, out: &mut [f64]) {
        out.fill(0.0);
        if self.assets.variant == Variant::Endless {
            out[self.state.journey.direction() as usize] = 1.0;
        }
    }

    fn state(&self) -> &State {
        &self.state
    }

    fn restore(&mut self, assets: &Arc<Assets>, state: State) -> Result<(), InvalidState> {
        if !state.is_valid() {
            return Err(InvalidState);
        }
        self.assets = Arc::clone(assets);
        self.state = state;
        Ok(())
    }

    fn info(&self, out: &mut [f64]) {
        match self.assets.variant {
            Variant::Free | Variant::Grid => out.copy_from_slice(&self.state.finite_info()),
            Variant::Endless => out.copy_from_slice(&self.state.endless_info()),
        }
    }
}
