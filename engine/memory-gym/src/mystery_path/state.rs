//! The state of a Mystery Path environment.

use serde::{Deserialize, Serialize};

use super::config::{Config, tile_at};
use super::endless::EndlessState;
use super::parameters::Variant;
use super::path::Tile;
use super::route::Route;
use crate::character::Character;
use endless_gym_core::envs::Progress;

/// Everything that changes during play.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// In pixels of the path's coordinates, along which the endless screen scrolls.
    pub(super) agent: Character,
    /// The tile of the agent's centre.
    pub(super) tile: Tile,
    pub(super) route: Route,
    /// Whether the agent fell off; the next step returns it to the start.
    pub(super) off_path: bool,
    /// Centre of the red cross on the screen, while it is shown.
    pub(super) cross: Option<(i32, i32)>,
    pub(super) fails: u32,
    pub(super) tiles_visited: u32,
    pub(super) steps: i64,
    /// Whether the goal was reached in this step.
    pub(super) success: bool,
    /// State of the endless id only.
    pub(super) endless: EndlessState,
}

impl State {
    /// Whether the rules can continue from this state. A forged snapshot may hold any numbers.
    pub(super) fn is_valid(&self) -> bool {
        const NEAR: i32 = 1 << 28;
        self.agent.is_valid()
            && self.tile == tile_at(self.agent.position)
            && self.route.is_valid()
            && self.endless.is_valid(&self.route)
            && self.cross.is_none_or(|(x, y)| x.abs_diff(0) < NEAR as u32 && y.abs_diff(0) < NEAR as u32)
            && [self.fails, self.tiles_visited].iter().all(|count| *count < u32::MAX / 2)
            && (0..i64::MAX / 2).contains(&self.steps)
    }

    /// Number of falls, and of tiles of the path that the agent was on, except the first one; and the endless id's stamina.
    pub(super) fn progress(&self, config: &Config) -> Vec<Progress> {
        let falls = Progress::count("falls", self.fails);
        if config.variant == Variant::Endless {
            let of = config.parameters.stamina_level as f64;
            let stamina = Progress::share("stamina", self.endless.stamina_left() as f64, of);
            return vec![Progress::count("tiles", self.tiles_visited), falls, stamina];
        }
        let tiles = self.tiles_visited + u32::from(self.success);
        vec![Progress::share("tiles", tiles, self.route.tiles().len() as f64 - 1.0), falls]
    }

    /// The final info of the finite ids: success, and the number of falls.
    pub(super) fn finite_info(&self) -> [f64; 2] {
        [f64::from(u8::from(self.success)), f64::from(self.fails)]
    }

    /// The final info of the endless id: falls, the farthest column, and tiles visited.
    pub(super) fn endless_info(&self) -> [f64; 3] {
        [f64::from(self.fails), f64::from(self.endless.farthest()), f64::from(self.tiles_visited)]
    }
}
