//! The state of a Mystery Path environment.

use serde::{Deserialize, Serialize};

use super::config::{Config, TILE, tile_at};
use super::endless::EndlessState;
use super::parameters::{Parameters, Variant};
use super::path::{Tile, TileSet};
use super::route::Route;
use crate::character::Character;
use crate::screen::SCREEN;
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
    /// Whether an environment can be in this state. A forged snapshot may hold any numbers.
    pub(super) fn is_valid(&self, config: &Config) -> bool {
        let (x, y) = self.agent.position;
        let centre = |(x, y): Tile| (x * TILE + TILE / 2, y * TILE + TILE / 2);
        if !self.route.is_valid() {
            return false;
        }
        // A large agent may start beyond the border, which it keeps its distance from when it moves.
        let (start_x, start_y) = self.origin(config);
        let end = |start: i32| (SCREEN as i32).max(start);
        self.agent.is_valid()
            && self.tile == tile_at(self.agent.position)
            && match config.variant {
                Variant::Free => x.min(y) >= 0 && x <= end(start_x) && y <= end(start_y),
                Variant::Grid => (x, y) == centre(self.tile) && TileSet::GRID.contains(self.tile),
                // One step off the path, at the most.
                Variant::Endless => x >= 0 && (-(SCREEN as i32)..=2 * SCREEN as i32 + config.agent.radius).contains(&y),
            }
            && self.endless.is_valid(&self.route, config, x - start_x)
            && (self.steps == 0 || self.success || self.off_path != self.route.contains(self.tile))
            && self.cross.is_none_or(|cross| self.off_path && cross == self.endless.on_screen(self.agent.position))
            && (0..i64::MAX / 2).contains(&self.steps)
            && [self.fails, self.tiles_visited]
                .iter()
                .all(|count| i64::from(*count) <= self.steps && *count < u32::MAX / 2)
    }

    /// Number of falls, and of tiles of the path that the agent was on, except the first one; and the endless id's stamina.
    pub(super) fn progress(&self, config: &Config) -> Vec<Progress> {
        let falls = Progress::count("falls", self.fails);
        if config.variant == Variant::Endless {
            let of = config.parameters.stamina_level as f64;
            let stamina = Progress::share("stamina", self.endless.stamina as f64, of);
            return vec![Progress::count("tiles", self.tiles_visited), falls, stamina];
        }
        let tiles = self.tiles_visited + u32::from(self.success);
        vec![Progress::share("tiles", tiles, self.route.tiles().len() as f64 - 1.0), falls]
    }

    /// The final info of the finite ids: success, the number of falls, and the task progress.
    pub(super) fn finite_info(&self, parameters: &Parameters) -> [f64; 3] {
        let success = f64::from(u8::from(self.success));
        let tiles = (f64::from(self.tiles_visited) + success) / (self.route.tiles().len() as f64 - 1.0);
        [success, f64::from(self.fails), if parameters.reward_path_progress > 0.0 { tiles } else { success }]
    }

    /// The final info of the endless id: falls, the farthest column, and tiles visited.
    pub(super) fn endless_info(&self) -> [f64; 3] {
        [f64::from(self.fails), f64::from(self.endless.farthest), f64::from(self.tiles_visited)]
    }
}
