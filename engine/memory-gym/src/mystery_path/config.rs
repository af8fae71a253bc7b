//! Reset parameters and the geometry derived from them.

use super::parameters::{Parameters, Variant};
use super::path::{GRID, Tile};
use crate::character::CharacterSize;
use crate::screen::SCREEN;

/// Side of a tile in pixels.
pub const TILE: i32 = SCREEN as i32 / GRID;

/// Maximum number of tiles on the screen to the left of the endless agent.
const MAX_CAMERA_OFFSET: f64 = 5.5;

/// Everything that the rules need in addition to the state.
#[derive(Clone, Debug)]
pub struct Config {
    /// The variant of the rules.
    pub variant: Variant,
    /// The reset parameters.
    pub parameters: Parameters,
    /// Dimensions of the agent.
    pub agent: CharacterSize,
    /// Left edge of the screen at the start of an episode, in pixels of the path's coordinates.
    pub camera: f64,
    /// Number of columns of the past path that are shown, besides the column next to the agent.
    pub past_depth: i32,
    /// Horizontal centre of the endless agent on the screen, which scrolls with it, in pixels.
    pub agent_x: i32,
}

impl Config {
    /// Computes the geometry.
    pub fn new(variant: Variant, parameters: Parameters) -> Self {
        let agent = CharacterSize::new(parameters.agent_scale);
        let camera = match variant {
            Variant::Free | Variant::Grid => 0.0,
            Variant::Endless => -f64::from(TILE) * parameters.camera_offset_scale.clamp(0.0, MAX_CAMERA_OFFSET),
        };
        // The picture's left edge, truncated when it is drawn.
        let left = f64::from(agent.radius - agent.centre()) - camera;
        Config {
            variant,
            agent,
            camera,
            past_depth: parameters.camera_offset_scale as i32,
            agent_x: left as i32 + agent.centre(),
            parameters,
        }
    }
}

/// The tile at a position in pixels.
pub fn tile_at((x, y): (i32, i32)) -> Tile {
    (x.div_euclid(TILE), y.div_euclid(TILE))
}
