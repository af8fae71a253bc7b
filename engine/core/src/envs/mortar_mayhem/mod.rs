//! Mortar Mayhem: memorise a sequence of commands, then execute it on an arena whose other tiles burn.

mod commands;
mod drawing;
pub mod expert;
mod features;
mod parameters;
mod rules;

use std::sync::Arc;

pub use commands::{COMMANDS, Command, MAX_VECTOR_COMMANDS};
pub use drawing::{Assets, Scene};
pub use parameters::{Locomotion, Parameters, SPECS, Variant};
pub use rules::{MortarMayhem, State};

use crate::envs::{Environment, InvalidState, ResetParameters, Transition};
use crate::random::Generator;
use crate::raster::Canvas;

impl Environment for MortarMayhem {
    type Variant = Variant;
    type Assets = Assets;
    type State = State;
    type Scene = Scene;

    fn assets(variant: Variant, parameters: &ResetParameters) -> Assets {
        Assets::new(variant, Parameters::new(variant, parameters))
    }

    fn new(assets: &Arc<Assets>) -> Self {
        MortarMayhem::unplayed(assets)
    }

    fn reset(&mut self, assets: &Arc<Assets>, random: &mut Generator) {
        self.start(assets, random);
    }

    fn step(&mut self, action: &[i32], random: &mut Generator) -> Transition {
        self.play(action, random)
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
        scene.damage_since(shown, assets).repair(canvas, |canvas| scene.paint(assets, canvas));
    }

    fn draw_ground_truth(&mut self, canvas: &mut Canvas<'_>) {
        self.draw_debug_frame(canvas);
    }

    fn vector_observation(&self, out: &mut [f32]) {
        out.fill(0.0);
        for (one_hot, command) in out.chunks_exact_mut(COMMANDS).zip(&self.state.commands) {
            one_hot[command.one_hot()] = 1.0;
        }
    }

    fn features(&self, out: &mut [f32]) {
        self.write_features(out);
    }

    fn ground_truth(&self, out: &mut [f64]) {
        let (x, y) = self.state.target;
        out.copy_from_slice(&[f64::from(x) / 5.0, f64::from(y) / 5.0]);
    }

    fn state(&self) -> &State {
        &self.state
    }

    fn restore(&mut self, assets: &Arc<Assets>, state: State) -> Result<(), InvalidState> {
        self.resume(assets, state)
    }

    fn info(&self, out: &mut [f64]) {
        out.copy_from_slice(&if self.assets.variant.endless { self.endless_info() } else { self.finite_info() });
    }
}
