//! The rules of Mystery Path: what all three ids share, and the goal of the finite ones.
//!
//! Source: `reset` and `step` of the original's `mystery_path.py`, `mystery_path_grid.py` and `endless_mystery_path.py`. The order
//! of the random draws is part of the rules, and so is the order in which rewards are summed.

use serde::{Deserialize, Serialize};

use super::drawing::{Assets, TILE};
use super::journey::Journey;
use super::parameters::Variant;
use super::path::{GRID, Tile};
use super::route::Route;
use crate::envs::character::{Bounds, Character};
use crate::envs::{SCREEN, Transition};
use crate::random::Generator;

/// Everything that changes about one environment.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// In pixels of the path's grid, which the endless screen scrolls along.
    pub(super) agent: Character,
    /// Tile that the agent's centre is on.
    pub(super) tile: Tile,
    pub(super) route: Route,
    /// The agent fell off, and the next step puts it back.
    pub(super) off_path: bool,
    /// Centre of the red cross on the screen, while there is one.
    pub(super) cross: Option<(i32, i32)>,
    pub(super) fails: u32,
    pub(super) tiles_visited: u32,
    pub(super) steps: i64,
    /// The goal was reached in this step.
    pub(super) success: bool,
    /// What only the endless id has.
    pub(super) journey: Journey,
}

impl State {
    pub(super) fn start(&mut self, assets: &Assets, random: &mut Generator) {
        if assets.variant == Variant::Endless {
            self.journey.start(&mut self.route, assets, random);
        } else {
            let (start, end) = draw_ends(*random.choice(&assets.parameters.cardinal_origin_choice), random);
            self.route.set_path(start, end, random);
        }
        let rotation = if assets.variant == Variant::Endless { 270 } else { 0 };
        self.agent = Character { position: self.origin(assets), rotation };
        self.tile = tile_at(self.agent.position);
        self.off_path = false;
        self.cross = None;
        self.fails = 0;
        self.tiles_visited = 0;
        self.steps = 0;
        self.success = false;
    }

    /// Whether playing on from the state stays within the rules: every number in its range.
    pub(super) fn is_valid(&self) -> bool {
        const NEAR: i32 = 1 << 28;
        self.agent.is_valid()
            && self.tile == tile_at(self.agent.position)
            && self.route.is_valid()
            && self.journey.is_valid(&self.route)
            && self.cross.is_none_or(|(x, y)| x.abs_diff(0) < NEAR as u32 && y.abs_diff(0) < NEAR as u32)
            && [self.fails, self.tiles_visited].iter().all(|count| *count < u32::MAX / 2)
            && (0..i64::MAX / 2).contains(&self.steps)
    }

    /// Where the agent starts.
    fn origin(&self, assets: &Assets) -> (i32, i32) {
        let inset = match assets.variant {
            Variant::Grid => TILE / 2,
            // In the middle of the tile at the default scale only.
            Variant::Free | Variant::Endless => assets.character.radius(),
        };
        let (x, y) = self.route.start();
        (x * TILE + inset, y * TILE + inset)
    }

    pub(super) fn play(&mut self, assets: &Assets, action: &[i32], random: &mut Generator) -> Transition {
        let parameters = &assets.parameters;
        let endless = assets.variant == Variant::Endless;
        let mut transition = Transition { reward: 0.0, terminated: false };
        self.move_agent(assets, action);
        self.tile = tile_at(self.agent.position);
        if endless {
            self.journey.extend(self.tile, &mut self.route, random);
        }
        self.success = !endless && self.tile == self.route.end();
        if self.success {
            transition.reward += parameters.reward_goal;
            transition.terminated = true;
        } else {
            self.judge(assets, &mut transition);
        }
        transition.reward += parameters.reward_step;
        if endless {
            transition.terminated |= self.journey.tire();
        }
        self.steps += 1;
        transition.terminated |= self.steps == parameters.max_steps;
        transition
    }

    /// Moves the agent, or puts it back to the start after a fall.
    fn move_agent(&mut self, assets: &Assets, action: &[i32]) {
        const BOUNDS: Bounds = (0, 0, SCREEN as i32, SCREEN as i32);
        let (speed, radius) = (assets.parameters.agent_speed, assets.character.radius());
        if self.off_path {
            self.agent.position = self.origin(assets);
        }
        match assets.variant {
            Variant::Free => {
                let action = if self.off_path { &[0, 0] } else { action };
                self.agent.step_within(action, speed, radius, BOUNDS);
            }
            Variant::Grid if self.off_path => {}
            Variant::Grid => {
                let (x, y) = self.agent.step_on_grid(action[0], self.tile, GRID);
                self.agent.position = (x * TILE + TILE / 2, y * TILE + TILE / 2);
            }
            Variant::Endless if self.off_path => self.journey.scroll_back(assets),
            Variant::Endless => {
                // Nothing, right, up, down.
                const MOVES: [[i32; 2]; 4] = [[0, 0], [2, 0], [0, 1], [0, 2]];
                let (x, _) = self.agent.step(&MOVES[action[0] as usize], speed);
                self.journey.scroll(x);
            }
        }
    }

    /// Rewards the agent for a new tile, or lets it fall.
    fn judge(&mut self, assets: &Assets, transition: &mut Transition) {
        let parameters = &assets.parameters;
        let visit = self.route.visit(self.tile);
        self.off_path = visit.is_none();
        self.cross = None;
        let Some(visit) = visit else {
            transition.reward += parameters.reward_fall_off;
            self.fails += 1;
            if parameters.visual_feedback {
                self.cross = Some(self.journey.on_screen(self.agent.position));
            }
            if assets.variant == Variant::Endless {
                transition.terminated |= self.journey.fall(self.tile, parameters.stamina_level);
                self.route.fall();
            }
            return;
        };
        if visit.first {
            transition.reward += parameters.reward_path_progress;
            self.tiles_visited += 1;
        }
        if visit.first_since_fall {
            transition.reward += parameters.reward_path_progress_dense;
            self.journey.rest(parameters.stamina_level);
        }
        if assets.variant == Variant::Endless {
            self.journey.arrive(self.tile, &self.route);
        }
    }

    /// The final info of the finite ids: success, and how often the agent fell off.
    pub(super) fn finite_info(&self) -> [f64; 2] {
        [f64::from(u8::from(self.success)), f64::from(self.fails)]
    }

    /// The final info of the endless id: falls, the farthest column, and tiles visited.
    pub(super) fn endless_info(&self) -> [f64; 3] {
        [f64::from(self.fails), f64::from(self.journey.farthest()), f64::from(self.tiles_visited)]
    }
}

/// The tile that a pixel lies on.
fn tile_at((x, y): (i32, i32)) -> Tile {
    (x.div_euclid(TILE), y.div_euclid(TILE))
}

/// Draws where a path begins and ends: on the given side of the grid, and on the one across from it.
pub(super) fn draw_ends(side: i64, random: &mut Generator) -> (Tile, Tile) {
    let first = random.integers(0, i64::from(GRID)) as i32;
    let second = random.integers(0, i64::from(GRID)) as i32;
    let last = GRID - 1;
    match side {
        0 => ((0, first), (last, second)),
        1 => ((last, first), (0, second)),
        2 => ((first, 0), (second, last)),
        _ => ((first, last), (second, 0)),
    }
}
