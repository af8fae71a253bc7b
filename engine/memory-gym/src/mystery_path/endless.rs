//! State and rules of the endless id only: the growing path, the scrolling screen, stamina, and the end of an episode.
//!
//! Source: the original's `endless_mystery_path.py`.

use serde::{Deserialize, Serialize};

use super::config::{Config, TILE};
use super::parameters::{MAX_STAMINA, Variant};
use super::path::Tile;
use super::route::{Route, SEGMENT};
use endless_gym_core::random::Generator;

/// Number of joined paths at the start of an episode.
const FIRST_SEGMENTS: usize = 3;

/// Direction of the next tile of the path. If the path leads left, where the agent cannot go, the last direction remains.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Direction {
    /// To the next column.
    #[default]
    Right,
    /// To the row above.
    Up,
    /// To the row below.
    Down,
}

/// State of the endless id in addition to that of the finite ids. In the finite ids it keeps its default: a screen that does
/// not scroll.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EndlessState {
    /// Left edge of the screen in pixels of the path's coordinates. Summed step by step, which determines its rounding.
    pub(super) camera: f64,
    /// Pixels that the background has scrolled to the left, less than a tile.
    pub(super) background: i32,
    /// Number of steps left to make progress.
    pub(super) stamina: i64,
    /// The farthest column of the path that the agent was on.
    pub(super) farthest: i32,
    /// Tiles in the farthest column or beyond where the agent fell off. A second fall at one of them ends the episode.
    falls: Vec<Tile>,
    /// Index in the route of the last tile that the agent was on.
    at: usize,
    /// Direction of the path from the last tile that the agent was on.
    pub(super) direction: Direction,
}

impl EndlessState {
    /// Starts an episode with a new route.
    pub(super) fn reset(&mut self, route: &mut Route, config: &Config, random: &mut Generator) {
        route.clear();
        (0..FIRST_SEGMENTS).for_each(|_| route.extend(random));
        self.scroll_back(config);
        self.stamina = config.parameters.stamina_level;
        self.farthest = 0;
        self.falls.clear();
        self.at = 0;
        self.update_direction(route);
    }

    /// Whether an environment can be in this state, with the agent `x` pixels to the right of its start. A forged snapshot may hold
    /// any numbers.
    pub(super) fn is_valid(&self, route: &Route, config: &Config, x: i32) -> bool {
        let scrolled = if config.variant == Variant::Endless { f64::from(x) } else { 0.0 };
        // Sums of fractions are rounded.
        (self.camera - config.camera - scrolled).abs() < 0.01
            && (0..TILE).contains(&self.background)
            // Negative while an episode continues after its end.
            && (-MAX_STAMINA..=MAX_STAMINA).contains(&self.stamina)
            && (0..=route.end().0).contains(&self.farthest)
            && self.falls.iter().all(|(x, _)| *x >= self.farthest)
            && self.at < route.tiles().len()
    }

    /// Moves the screen with the agent by `x` pixels.
    pub(super) fn scroll(&mut self, x: i32) {
        self.camera += f64::from(x);
        self.background += x;
        // The original keeps the remainder modulo the agent's speed, which is always 0 since all steps have the same length.
        if self.background >= TILE {
            self.background = 0;
        }
    }

    /// Moves the screen back to the start.
    pub(super) fn scroll_back(&mut self, config: &Config) {
        self.camera = config.camera;
        self.background = 0;
    }

    /// Adds a path once the agent is on the last path but one.
    pub(super) fn extend(&self, (x, _): Tile, route: &mut Route, random: &mut Generator) {
        if i64::from(x / SEGMENT) > route.segments() as i64 - 2 {
            route.extend(random);
        }
    }

    /// Records a fall at `tile` and restores the stamina. Returns whether the fall ends the episode.
    pub(super) fn fall(&mut self, tile: Tile, stamina: i64) -> bool {
        self.stamina = stamina;
        if tile.0 < self.farthest || self.falls.contains(&tile) {
            return true;
        }
        self.falls.push(tile);
        false
    }

    /// Records that the agent is on a tile of the route.
    pub(super) fn arrive(&mut self, tile: Tile, route: &Route) {
        if route.tiles().get(self.at) != Some(&tile) {
            self.at = route.index(tile).unwrap_or(self.at);
            self.update_direction(route);
        }
        if tile.0 > self.farthest {
            self.farthest = tile.0;
            // Any fall before the farthest column ends the episode.
            self.falls.retain(|(x, _)| *x >= tile.0);
        }
    }

    fn update_direction(&mut self, route: &Route) {
        let Some(&[(from_x, from_y), (x, y)]) = route.tiles().get(self.at..).and_then(|tiles| tiles.first_chunk())
        else {
            return;
        };
        self.direction = match (x - from_x, y - from_y) {
            (1, _) => Direction::Right,
            (_, -1) => Direction::Up,
            (_, 1) => Direction::Down,
            _ => self.direction,
        };
    }

    /// Spends one unit of stamina. Returns whether none is left.
    pub(super) fn spend_stamina(&mut self) -> bool {
        self.stamina -= 1;
        self.stamina == 0
    }

    /// Converts a position in the path's coordinates to one on the screen, rounded as pygame rounds a rectangle's centre.
    pub(super) fn on_screen(&self, (x, y): (i32, i32)) -> (i32, i32) {
        ((f64::from(x) - self.camera).round() as i32, y)
    }

    /// The share of the stamina that is left, at most 1. Negative if the episode continues after its end.
    pub(super) fn stamina_share(&self, full: i64) -> f64 {
        self.stamina.min(full) as f64 / full as f64
    }

    /// The tiles before the last one that the agent was on, backwards to the column that is `depth` columns before the one next
    /// to the agent.
    ///
    /// As in the original, a path that turns back can be cut short, and if the agent is off the path, the columns count from
    /// where it fell.
    pub(super) fn past_path<'a>(
        &self,
        (x, _): Tile,
        depth: i32,
        route: &'a Route,
    ) -> impl Iterator<Item = Tile> + use<'a> {
        let mut column = x - 1;
        let last = (column - depth).max(0);
        let mut over = false;
        route.tiles()[..self.at].iter().rev().copied().take_while(move |tile| {
            let shown = !over && column >= last;
            column = tile.0;
            over = column == last;
            shown
        })
    }
}
