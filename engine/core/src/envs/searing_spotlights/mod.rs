//! Searing Spotlights: collect coins in the dark, unseen by the spotlights that are the only light.
//!
//! What the original does that looks like a mistake is kept, since it is part of what agents learn from:
//!
//! - A spotlight that has arrived is removed a step later, and the next one in the list then misses that step: it is neither
//!   moved nor drawn, and does not burn. Likewise for a coin that follows a collected one.
//! - Spotlights of the finite id come at a constant interval; `spawn_interval_decay` and `reward_max_steps` have no effect.
//! - An episode's first frame shows the circles that the last episode lit, and turns the agent upwards.
//! - A background once painted over by `hide_chessboard` or `black_background` stays so in later episodes of the environment.
//! - The endless id without `coin_enabled` has a black background, and hides even the spotlights for `coin_show_duration` steps.
//! - With `num_coins: [0]` the exit is open from the first step, and the share of coins in the info is not a number.
//! - What is visible in the dark is drawn above the bar at the top, or below it, depending on what else is visible.
//!
//! Where the original raises an error, the options do what their documentation promises:
//!
//! - `use_exit: false`: there is no exit, not even one that an earlier episode left behind, and an episode is won with the last
//!   coin. Without coins as well, it goes on until the agent dies or `max_steps` are over.
//! - More coins than the screen has room for are placed regardless of each other.
//! - The endless id's `show_last_action: false`: the bar does not show the action.
//! - `spot_min_radius` above `spot_max_radius`: all spotlights have the former.
//!
//! There are limits that the original does not have: see [`parameters`].

mod drawing;
pub mod expert;
mod features;
mod light;
pub mod parameters;
mod rules;
mod scene;
mod shape;
mod spawning;
mod spotlight;
#[cfg(test)]
mod tests;
mod top_bar;

use std::sync::Arc;

pub use drawing::Assets;
pub use parameters::{Parameters, SPECS, Variant};
pub use rules::{SearingSpotlights, State};
pub use scene::Scene;

use crate::envs::{Environment, InvalidState, ResetParameters, Transition};
use crate::random::Generator;
use crate::raster::Canvas;

impl Environment for SearingSpotlights {
    type Variant = Variant;
    type Assets = Assets;
    type State = State;
    type Scene = Scene;

    fn assets(variant: Variant, parameters: &ResetParameters) -> Assets {
        Assets::new(variant, Parameters::new(variant, parameters))
    }

    fn new(assets: &Arc<Assets>) -> Self {
        SearingSpotlights { assets: Arc::clone(assets), state: State::unplayed() }
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
        self.shown_scene()
    }

    fn paint(assets: &Assets, scene: &Scene, canvas: &mut Canvas<'_>) {
        scene.paint(assets, canvas);
    }

    fn repaint(assets: &Assets, shown: &Scene, scene: &Scene, canvas: &mut Canvas<'_>) {
        scene.repaint(shown, assets, canvas);
    }

    fn draw_ground_truth(&mut self, canvas: &mut Canvas<'_>) {
        self.draw_truth(canvas);
    }

    fn features(&self, out: &mut [f32]) {
        self.write_features(out);
    }

    fn ground_truth(&self, out: &mut [f64]) {
        if self.assets.variant.endless {
            out.copy_from_slice(&self.state.ground_truth());
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
        let parameters = &self.assets.parameters;
        if self.assets.variant.endless {
            out.copy_from_slice(&self.state.endless_info(parameters));
        } else {
            out.copy_from_slice(&self.state.finite_info(parameters));
        }
    }
}
