//! What a frame of Mortar Mayhem shows, in numbers.

use super::commands::COMMANDS;
use super::rules::MortarMayhem;
use crate::envs::SCREEN;

/// Places of the columns in [`super::parameters::FEATURES`].
pub(super) const AGENT: usize = 0;
pub(super) const HEADING: usize = 2;
pub(super) const COMMAND: usize = 4;
pub(super) const BURNING: usize = COMMAND + COMMANDS;
pub(super) const SAFE: usize = BURNING + 1;
pub(super) const ARENA_SIZE: usize = SAFE + 2;

/// By how much tile numbers and arena sizes are divided.
pub(super) const LAST_TILE: f32 = 5.0;
pub(super) const LARGEST_ARENA: f32 = 6.0;

impl MortarMayhem {
    pub(super) fn write_features(&self, out: &mut [f32]) {
        out.fill(0.0);
        let (_, character) = self.shown_character();
        let share = |pixels: i32| pixels as f32 / SCREEN as f32;
        out[AGENT] = share(character.position.0);
        out[AGENT + 1] = share(character.position.1);
        out[HEADING..HEADING + 2].copy_from_slice(&character.heading());
        if let Some(command) = self.state.shown_command {
            out[COMMAND + command.index()] = 1.0;
        }
        if let Some((x, y)) = self.visible_fire() {
            out[BURNING] = 1.0;
            out[SAFE] = x as f32 / LAST_TILE;
            out[SAFE + 1] = y as f32 / LAST_TILE;
        }
        out[ARENA_SIZE] = self.assets.parameters.arena_size as f32 / LARGEST_ARENA;
    }
}
