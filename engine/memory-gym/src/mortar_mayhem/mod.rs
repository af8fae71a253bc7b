//! Mortar Mayhem: memorise a sequence of commands, then execute it in an arena whose other tiles burn.

mod commands;
mod config;
mod display_schedule;
mod drawing;
pub mod expert;
mod features;
mod parameters;
mod registry;
mod rules;
mod state;

use std::sync::Arc;

pub use commands::{COMMANDS, Command, MAX_VECTOR_COMMANDS};
pub use config::Config;
pub use drawing::{Assets, Scene};
pub use parameters::{Locomotion, Parameters, Variant};
pub use registry::IDS;
pub use state::State;

use crate::character_sprites::CharacterSprites;
use crate::shared_methods::shared_methods;
use endless_gym_core::envs::{Environment, Expert, InvalidState, ResetParameters};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;
use state::DisplayedCharacter;

/// One environment of the family.
#[derive(Clone, Debug)]
pub struct MortarMayhem {
    assets: Arc<Assets>,
    state: State,
    /// Pictures of [`DisplayedCharacter::Earlier`].
    earlier_sprites: Arc<CharacterSprites>,
}

impl Environment for MortarMayhem {
    shared_methods!();

    fn new(assets: &Arc<Assets>) -> Self {
        let earlier_sprites = Arc::clone(&assets.character);
        MortarMayhem { assets: Arc::clone(assets), state: State::default(), earlier_sprites }
    }

    fn reset(&mut self, assets: &Arc<Assets>, random: &mut Generator) {
        // A needless clone would write to a count on a cache line that all threads read.
        if self.state.displayed == DisplayedCharacter::Current
            && !Arc::ptr_eq(&self.earlier_sprites, &self.assets.character)
        {
            self.earlier_sprites = Arc::clone(&self.assets.character);
        }
        let last_scale = self.assets.config.parameters.agent_scale;
        if !Arc::ptr_eq(&self.assets, assets) {
            self.assets = Arc::clone(assets);
        }
        self.state.reset(&assets.config, last_scale, random);
    }

    fn scene(&self) -> Scene {
        Scene::new(&self.state, &self.assets.config, &self.assets.character, &self.earlier_sprites)
    }

    fn repaint(assets: &Assets, shown: &Scene, scene: &Scene, canvas: &mut Canvas<'_>) {
        scene.damage_since(shown, assets, canvas.tracks_dirty()).repair(canvas, |canvas| scene.paint(assets, canvas));
    }

    fn draw_ground_truth(&mut self, canvas: &mut Canvas<'_>) {
        self.assets.draw_ground_truth(&mut self.state, &self.earlier_sprites, canvas);
    }

    fn align_ground_truth(&mut self) {
        self.state.align_view_display();
    }

    fn vector_observation(&self, out: &mut [f32]) {
        out.fill(0.0);
        for (one_hot, command) in out.chunks_exact_mut(COMMANDS).zip(&self.state.commands) {
            one_hot[command.one_hot()] = 1.0;
        }
    }

    fn ground_truth(&self, out: &mut [f64]) {
        let (x, y) = self.state.target;
        out.copy_from_slice(&[f64::from(x) / 5.0, f64::from(y) / 5.0]);
    }

    fn restore(&mut self, assets: &Arc<Assets>, state: State) -> Result<(), InvalidState> {
        if !state.is_valid(&assets.config) {
            return Err(InvalidState);
        }
        self.assets = Arc::clone(assets);
        self.earlier_sprites = assets.displayed_sprites(&state);
        self.state = state;
        Ok(())
    }

    fn info(&self, out: &mut [f64]) {
        match self.assets.config.variant.endless {
            true => out.copy_from_slice(&self.state.endless_info()),
            false => out.copy_from_slice(&self.state.finite_info()),
        }
    }

    fn expert(variant: Variant, _: &ResetParameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(expert::MortarExpert::new(variant)))
    }
}
