//! The scene of a Mystery Path frame.

use super::config::{Config, TILE};
use super::parameters::Variant;
use super::path::{Tile, TileSet};
use super::state::State;
use crate::character::Character;
use crate::screen::SCREEN;

/// What a frame shows.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    pub(super) goal: Option<Tile>,
    pub(super) origin: Option<Tile>,
    pub(super) past: PastPath,
    pub(super) agent: Character,
    /// Number of red rows in the stamina bar, if it is shown.
    pub(super) spent: Option<i32>,
    /// Centre of the red cross.
    pub(super) cross: Option<(i32, i32)>,
    /// Pixels that the background has scrolled to the left.
    pub(super) background: i32,
}

/// The tiles of the past path that are on the screen.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct PastPath {
    /// Left edge of the screen in pixels of the path's coordinates.
    camera: f64,
    /// The tiles' first column.
    first: i32,
    /// With columns relative to `first`.
    tiles: TileSet,
}

impl PastPath {
    /// The left and top edges of the tiles in pixels of the screen, truncated as they are drawn.
    pub(super) fn positions(self) -> impl Iterator<Item = (i32, i32)> {
        self.tiles.iter().map(move |(x, y)| ((f64::from((self.first + x) * TILE) - self.camera) as i32, y * TILE))
    }
}

impl State {
    /// The scene of the state.
    pub(super) fn scene(&self, config: &Config) -> Scene {
        let parameters = &config.parameters;
        Scene {
            goal: parameters.show_goal.then(|| self.route.end()),
            origin: parameters.show_origin.then(|| self.route.start()),
            past: if parameters.show_past_path { self.past(config) } else { PastPath::default() },
            agent: self.shown_agent(config),
            spent: parameters.show_stamina.then(|| self.spent_stamina(config)),
            cross: self.cross,
            background: if parameters.show_background { self.endless.background } else { 0 },
        }
    }

    fn past(&self, config: &Config) -> PastPath {
        // At most eight columns are on the screen.
        let Some(first) = self.past_tiles(config).map(|(x, _)| x).min() else { return PastPath::default() };
        let mut past = PastPath { camera: self.endless.camera, first, tiles: TileSet::default() };
        self.past_tiles(config).for_each(|(x, y)| past.tiles.insert((x - first, y)));
        past
    }

    /// The past path's tiles on the screen, whose left edges are truncated to pixels as they are drawn.
    pub(super) fn past_tiles(&self, config: &Config) -> impl Iterator<Item = Tile> {
        let camera = self.endless.camera;
        let left = move |(x, _): &Tile| (f64::from(x * TILE) - camera) as i32;
        self.endless
            .past_path(self.tile, config.past_depth, &self.route)
            .filter(move |tile| (1 - TILE..SCREEN as i32).contains(&left(tile)))
    }

    /// The agent at its position on the screen.
    pub(super) fn shown_agent(&self, config: &Config) -> Character {
        match config.variant {
            Variant::Free | Variant::Grid => self.agent,
            Variant::Endless => Character { position: (config.agent_x, self.agent.position.1), ..self.agent },
        }
    }

    /// Number of red rows in the stamina bar.
    pub(super) fn spent_stamina(&self, config: &Config) -> i32 {
        let left = self.endless.stamina_share(config.parameters.stamina_level);
        (SCREEN as f64 * (1.0 - left)) as i32
    }
}
