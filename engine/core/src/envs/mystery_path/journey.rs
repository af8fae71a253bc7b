//! What only the endless id has: a way that goes on, a screen that scrolls, stamina, and the ways to fail.
//!
//! Source: the original's `endless_mystery_path.py`.

use serde::{Deserialize, Serialize};

use super::drawing::{Assets, TILE};
use super::path::Tile;
use super::route::{Route, SEGMENT};
use crate::random::Generator;

/// Paths that the way begins with.
const FIRST_SEGMENTS: usize = 3;

/// Where the way leads next. A way can also lead left, where the agent cannot go; then the last direction remains.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Direction {
    #[default]
    Right,
    Up,
    Down,
}

/// State of the endless id beside what it shares with the finite ones, whose screen stands still.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Journey {
    /// Left edge of the screen in pixels of the way. Summed up step by step, as floats round.
    camera: f64,
    /// Pixels that the background has scrolled to the left, less than a tile.
    background: i32,
    stamina: i64,
    /// The farthest column of the way that the agent was on.
    farthest: i32,
    /// Where the agent fell off in that column or beyond: a second fall there ends the episode.
    falls: Vec<Tile>,
    /// Number along the way of the last tile that the agent was on.
    at: usize,
    direction: Direction,
}

impl Journey {
    /// Starts an episode with a new way.
    pub(super) fn start(&mut self, route: &mut Route, assets: &Assets, random: &mut Generator) {
        route.clear();
        (0..FIRST_SEGMENTS).for_each(|_| route.extend(random));
        self.scroll_back(assets);
        self.stamina = assets.parameters.stamina_level;
        self.farthest = 0;
        self.falls.clear();
        self.at = 0;
        self.look_ahead(route);
    }

    /// Whether every number is in its range.
    pub(super) fn is_valid(&self, route: &Route) -> bool {
        const FAR: i32 = 1 << 28;
        self.camera.abs() < f64::from(FAR)
            && (0..TILE).contains(&self.background)
            && self.stamina.checked_abs().is_some_and(|stamina| stamina < i64::MAX / 2)
            && (0..FAR).contains(&self.farthest)
            && self.at < route.tiles().len()
    }

    /// Moves the screen with the agent by `x` pixels.
    pub(super) fn scroll(&mut self, x: i32) {
        self.camera += f64::from(x);
        self.background += x;
        // Always to 0: the original keeps the remainder by the agent's speed, but all steps are equally long.
        if self.background >= TILE {
            self.background = 0;
        }
    }

    /// Moves the screen back to where it was at first.
    pub(super) fn scroll_back(&mut self, assets: &Assets) {
        self.camera = assets.camera;
        self.background = 0;
    }

    /// Adds a path when the agent is on the last but one.
    pub(super) fn extend(&self, (x, _): Tile, route: &mut Route, random: &mut Generator) {
        if i64::from(x / SEGMENT) > route.segments() as i64 - 2 {
            route.extend(random);
        }
    }

    /// Falls off at `tile`: whether that ends the episode.
    pub(super) fn fall(&mut self, tile: Tile, stamina: i64) -> bool {
        self.stamina = stamina;
        if tile.0 < self.farthest || self.falls.contains(&tile) {
            return true;
        }
        self.falls.push(tile);
        false
    }

    /// Has reached a tile of the way.
    pub(super) fn arrive(&mut self, tile: Tile, route: &Route) {
        if route.tiles().get(self.at) != Some(&tile) {
            self.at = route.number(tile).unwrap_or(self.at);
            self.look_ahead(route);
        }
        if tile.0 > self.farthest {
            self.farthest = tile.0;
            // A fall before the farthest column ends the episode anyway.
            self.falls.retain(|(x, _)| *x >= tile.0);
        }
    }

    fn look_ahead(&mut self, route: &Route) {
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

    /// Regains all stamina.
    pub(super) fn rest(&mut self, stamina: i64) {
        self.stamina = stamina;
    }

    /// Spends stamina on a step: whether none is left.
    pub(super) fn tire(&mut self) -> bool {
        self.stamina -= 1;
        self.stamina == 0
    }

    /// Where a pixel of the way is on the screen, rounded as pygame rounds a rectangle's centre.
    pub(super) fn on_screen(&self, (x, y): (i32, i32)) -> (i32, i32) {
        ((f64::from(x) - self.camera).round() as i32, y)
    }

    /// Left edge of the screen in pixels of the way.
    pub(super) fn camera(&self) -> f64 {
        self.camera
    }

    /// Pixels that the background has scrolled to the left, less than a tile.
    pub(super) fn background(&self) -> i32 {
        self.background
    }

    /// The share of the stamina that is left; negative if the episode is played on after its end.
    pub(super) fn stamina_share(&self, full: i64) -> f64 {
        self.stamina.min(full) as f64 / full as f64
    }

    /// The farthest column of the way that the agent was on.
    pub(super) fn farthest(&self) -> i32 {
        self.farthest
    }

    /// Where the way leads from the last tile that the agent was on.
    pub(super) fn direction(&self) -> Direction {
        self.direction
    }

    /// The tiles before the last one that the agent was on, backwards until one in the column `depth` columns before the
    /// agent's neighbour column.
    ///
    /// As in the original: a way that turns back can be cut short, and for an agent off the path the columns count from where it
    /// fell.
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
