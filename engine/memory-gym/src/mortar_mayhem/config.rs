//! Reset parameters and the geometry derived from them.

use super::parameters::{Parameters, Variant};
use crate::character::{Bounds, CharacterSize};
use crate::screen::SCREEN;

/// Side of a tile in pixels.
pub const TILE: i32 = 14;

/// Everything that the rules need in addition to the state.
#[derive(Clone, Debug)]
pub struct Config {
    /// The variant of the rules.
    pub variant: Variant,
    /// The reset parameters.
    pub parameters: Parameters,
    /// Dimensions of the agent.
    pub agent: CharacterSize,
    /// The arena's rectangle on the screen.
    pub arena: Bounds,
}

impl Config {
    /// Computes the geometry.
    pub fn new(variant: Variant, parameters: Parameters) -> Self {
        let side = parameters.arena_size * TILE;
        let corner = (SCREEN as i32 - side) / 2;
        Config {
            variant,
            agent: CharacterSize::new(parameters.agent_scale),
            arena: (corner, corner, corner + side, corner + side),
            parameters,
        }
    }

    /// The top left corner of a tile in pixels.
    pub fn corner(&self, (x, y): (i32, i32)) -> (i32, i32) {
        (self.arena.0 + x * TILE, self.arena.1 + y * TILE)
    }

    /// The centre of a tile in pixels.
    pub fn centre(&self, tile: (i32, i32)) -> (i32, i32) {
        let (left, top) = self.corner(tile);
        (left + TILE / 2, top + TILE / 2)
    }

    /// The tile at a position in pixels.
    pub fn tile_at(&self, (x, y): (i32, i32)) -> (i32, i32) {
        ((x - self.arena.0).div_euclid(TILE), (y - self.arena.1).div_euclid(TILE))
    }

    /// Whether a tile is part of the arena.
    pub fn contains(&self, (x, y): (i32, i32)) -> bool {
        let columns = 0..self.parameters.arena_size;
        columns.contains(&x) && columns.contains(&y)
    }
}
