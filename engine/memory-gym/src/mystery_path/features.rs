//! The feature observation of Mystery Path: the content of a frame as numbers. It does not contain the path, which the agent
//! must remember.

use super::config::{Config, TILE};
use super::parameters::Variant;
use super::path::GRID;
use super::state::State;
use crate::controls::column;
use crate::screen::SCREEN;
use endless_gym_core::envs::Column;

/// Indices of the columns that all ids have.
pub(super) const AGENT: usize = 0;
pub(super) const HEADING: usize = 2;
pub(super) const FALLEN: usize = 4;
const SHARED: usize = FALLEN + 1;
/// Indices in [`finite_features`].
const ORIGIN: usize = SHARED;
const GOAL: usize = ORIGIN + 3;
/// Indices in [`endless_features`].
pub(super) const STAMINA: usize = SHARED;
pub(super) const BACKGROUND: usize = STAMINA + 2;
pub(super) const PAST_SHIFT: usize = BACKGROUND + 1;
pub(super) const PAST_PATH: usize = PAST_SHIFT + 1;

/// Columns of tiles that are on the screen in whole or in part.
const SCREEN_COLUMNS: i32 = GRID + 1;

/// Divisor of a tile's column and row.
const LAST_TILE: f32 = GRID as f32 - 1.0;

const SHARED_COLUMNS: [Column; SHARED] = [
    column("agent_x", "horizontal centre of the agent on the screen, divided by 84"),
    column("agent_y", "vertical centre of the agent on the screen, divided by 84"),
    column("heading_x", "direction of the agent: horizontal part of a unit vector"),
    column("heading_y", "direction of the agent: vertical part of a unit vector, down is positive"),
    column("fallen", "1 while the red cross is seen: the agent fell off the path"),
];

/// The columns of the finite ids.
pub fn finite_features() -> &'static [Column] {
    let own = [
        column("origin_shown", "1 if the path's first tile is seen"),
        column("origin_x", "column of the path's first tile, divided by 6; 0 if it is not seen"),
        column("origin_y", "row of the path's first tile, divided by 6; 0 if it is not seen"),
        column("goal_shown", "1 if the goal is seen"),
        column("goal_x", "column of the goal, divided by 6; 0 if it is not seen"),
        column("goal_y", "row of the goal, divided by 6; 0 if it is not seen"),
    ];
    [SHARED_COLUMNS.as_slice(), &own].concat().leak()
}

/// The columns of the endless id.
pub fn endless_features() -> &'static [Column] {
    let own = [
        column("stamina_shown", "1 if the stamina bar is seen"),
        column("stamina", "green share of the stamina bar; 0 if it is not seen"),
        column("background_shift", "tiles that the background has scrolled to the left; 0 if it is not seen"),
        column(
            "past_shift",
            "offset in tiles of column 0 of the past path to the left of the screen; 0 if none is seen",
        ),
    ];
    let past_path = (0..SCREEN_COLUMNS).flat_map(|x| (0..GRID).map(move |y| format!("past_{x}_{y}").leak()));
    let past_path: Vec<Column> = past_path
        .map(|name| column(name, "1 if the past path's tile in this column and row of the screen is seen"))
        .collect();
    [SHARED_COLUMNS.as_slice(), &own, &past_path].concat().leak()
}

impl State {
    /// Writes the feature observation.
    pub(super) fn write_features(&self, config: &Config, out: &mut [f32]) {
        out.fill(0.0);
        let character = self.shown_agent(config);
        out[AGENT] = character.position.0 as f32 / SCREEN as f32;
        out[AGENT + 1] = character.position.1 as f32 / SCREEN as f32;
        out[HEADING..HEADING + 2].copy_from_slice(&character.heading());
        out[FALLEN] = f32::from(u8::from(self.cross.is_some()));
        if config.variant == Variant::Endless {
            self.write_endless(config, out);
            return;
        }
        let parameters = &config.parameters;
        let tiles =
            [(ORIGIN, parameters.show_origin, self.route.start()), (GOAL, parameters.show_goal, self.route.end())];
        for (place, _, (x, y)) in tiles.into_iter().filter(|(_, shown, _)| *shown) {
            out[place..place + 3].copy_from_slice(&[1.0, x as f32 / LAST_TILE, y as f32 / LAST_TILE]);
        }
    }

    fn write_endless(&self, config: &Config, out: &mut [f32]) {
        let parameters = &config.parameters;
        if parameters.show_stamina {
            out[STAMINA] = 1.0;
            out[STAMINA + 1] = self.endless.stamina_share(parameters.stamina_level).max(0.0) as f32;
        }
        if parameters.show_background {
            out[BACKGROUND] = self.endless.background as f32 / TILE as f32;
        }
        if parameters.show_past_path {
            let camera = self.endless.camera / f64::from(TILE);
            for (x, row) in self.past_tiles(config) {
                let column = (x - camera.floor() as i32).clamp(0, GRID);
                out[PAST_SHIFT] = (camera - camera.floor()) as f32;
                out[PAST_PATH + (column * GRID + row) as usize] = 1.0;
            }
        }
    }
}
