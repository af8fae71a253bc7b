//! Reset parameters and the geometry derived from them.

use super::parameters::{MAX_SPOTLIGHTS, Parameters, Variant};
use crate::character::CharacterSize;
use crate::screen::SCREEN;

/// Height in pixels of the bar at the top of the screen, which the agent cannot enter.
pub const BAR_HEIGHT: usize = 4;

/// Width in pixels of the health bar, the left half of the bar at the top.
pub const HEALTH_WIDTH: usize = SCREEN / 2;

/// Everything that the rules need in addition to the state.
#[derive(Clone, Debug)]
pub struct Config {
    /// The variant of the rules.
    pub variant: Variant,
    /// The reset parameters.
    pub parameters: Parameters,
    /// Dimensions of the agent.
    pub agent: CharacterSize,
    /// Radius of a coin in pixels.
    pub coin_radius: i32,
    /// The agent reaches the exit if its border is within this many pixels of the exit's centre.
    pub exit_radius: f64,
    /// Side of the exit's picture in pixels.
    pub exit_side: i32,
    /// Typical number of spotlights at a time, plus a reserve: the capacity to allocate.
    pub typical_spotlights: usize,
}

impl Config {
    /// Computes the geometry.
    pub fn new(variant: Variant, parameters: Parameters) -> Self {
        Config {
            variant,
            agent: CharacterSize::new(parameters.agent_scale),
            coin_radius: (10.0 * parameters.coin_scale) as i32,
            exit_radius: 20.0 / 2.0 * parameters.exit_scale,
            exit_side: (20.0 * parameters.exit_scale) as i32,
            typical_spotlights: typical_spotlights(&parameters),
            parameters,
        }
    }
}

/// The number of spotlights in the steady state, in which as many leave as appear, plus a reserve.
fn typical_spotlights(parameters: &Parameters) -> usize {
    let lifetime = 1.0 / parameters.spot_min_speed.max(1e-9);
    let at_once = (lifetime / parameters.spawn_interval.max(1) as f64).min(parameters.num_spawns as f64);
    (parameters.initial_spawns + at_once as usize + 3).min(MAX_SPOTLIGHTS)
}
