//! The feature observation of Mortar Mayhem: the content of a frame as numbers.

use super::commands::COMMANDS;
use super::config::Config;
use super::state::State;
use crate::controls::column;
use crate::screen::SCREEN;
use endless_gym_core::envs::Column;

/// Indices of the columns in [`FEATURES`].
pub(super) const AGENT: usize = 0;
pub(super) const HEADING: usize = 2;
pub(super) const COMMAND: usize = 4;
pub(super) const BURNING: usize = COMMAND + COMMANDS;
pub(super) const SAFE: usize = BURNING + 1;
pub(super) const ARENA_SIZE: usize = SAFE + 2;

/// Divisors of tile numbers and arena sizes.
pub(super) const LAST_TILE: f32 = 5.0;
pub(super) const LARGEST_ARENA: f32 = 6.0;

/// The columns of the feature observation.
pub const FEATURES: &[Column] = &[
    column("agent_x", "x of the agent's centre as a share of the screen's width"),
    column("agent_y", "y of the agent's centre as a share of the screen's height"),
    column("heading_x", "x of the agent's heading, a unit vector"),
    column("heading_y", "y of the agent's heading, a unit vector"),
    column("command_right", "1 while this command is shown"),
    column("command_down", "1 while this command is shown"),
    column("command_left", "1 while this command is shown"),
    column("command_up", "1 while this command is shown"),
    column("command_stay", "1 while this command is shown"),
    column("command_right_down", "1 while this command is shown"),
    column("command_right_up", "1 while this command is shown"),
    column("command_left_down", "1 while this command is shown"),
    column("command_left_up", "1 while this command is shown"),
    column("burning", "1 while tiles are red"),
    column("safe_x", "column of the tile that is not red, divided by 5; 0 while none is red"),
    column("safe_y", "row of the tile that is not red, divided by 5; 0 while none is red"),
    column("arena_size", "tiles along a side of the arena, divided by 6"),
];

impl State {
    /// Writes the feature observation.
    pub(super) fn write_features(&self, config: &Config, out: &mut [f32]) {
        out.fill(0.0);
        let character = self.visible_character();
        let share = |pixels: i32| pixels as f32 / SCREEN as f32;
        out[AGENT] = share(character.position.0);
        out[AGENT + 1] = share(character.position.1);
        out[HEADING..HEADING + 2].copy_from_slice(&character.heading());
        if let Some(command) = self.shown_command {
            out[COMMAND + command.index()] = 1.0;
        }
        if let Some((x, y)) = self.visible_fire(&config.parameters) {
            out[BURNING] = 1.0;
            out[SAFE] = x as f32 / LAST_TILE;
            out[SAFE + 1] = y as f32 / LAST_TILE;
        }
        out[ARENA_SIZE] = config.parameters.arena_size as f32 / LARGEST_ARENA;
    }
}
