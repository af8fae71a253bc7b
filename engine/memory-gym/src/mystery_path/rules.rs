//! The rules of Mystery Path: those of all three ids, and the goal of the finite ids.
//!
//! Source: `reset` and `step` of the original's `mystery_path.py`, `mystery_path_grid.py` and `endless_mystery_path.py`. The
//! order of the random draws and the order in which rewards are summed are part of the rules.

use super::config::{Config, TILE, tile_at};
use super::parameters::Variant;
use super::path::{GRID, draw_ends};
use super::state::State;
use crate::character::{Bounds, Character};
use crate::screen::SCREEN;
use endless_gym_core::envs::Transition;
use endless_gym_core::random::Generator;

impl State {
    /// Starts an episode.
    pub(super) fn reset(&mut self, config: &Config, random: &mut Generator) {
        if config.variant == Variant::Endless {
            self.endless.reset(&mut self.route, config, random);
        } else {
            let (start, end) = draw_ends(*random.choice(&config.parameters.cardinal_origin_choice), random);
            self.route.set_path(start, end, random);
        }
        let rotation = if config.variant == Variant::Endless { 270 } else { 0 };
        self.agent = Character { position: self.origin(config), rotation };
        self.tile = tile_at(self.agent.position);
        self.off_path = false;
        self.cross = None;
        self.fails = 0;
        self.tiles_visited = 0;
        self.steps = 0;
        self.success = false;
    }

    /// The agent's start position.
    pub(super) fn origin(&self, config: &Config) -> (i32, i32) {
        let inset = match config.variant {
            Variant::Grid => TILE / 2,
            // The middle of the tile only at the default scale.
            Variant::Free | Variant::Endless => config.agent.radius,
        };
        let (x, y) = self.route.start();
        (x * TILE + inset, y * TILE + inset)
    }

    /// Plays one step.
    pub(super) fn step(&mut self, config: &Config, action: &[i32], random: &mut Generator) -> Transition {
        let parameters = &config.parameters;
        let endless = config.variant == Variant::Endless;
        let mut transition = Transition::default();
        self.move_agent(config, action);
        self.tile = tile_at(self.agent.position);
        if endless {
            self.endless.extend(self.tile, &mut self.route, random);
        }
        self.success = !endless && self.tile == self.route.end();
        if self.success {
            transition.reward += parameters.reward_goal;
            transition.terminated = true;
        } else {
            self.check_tile(config, &mut transition);
        }
        transition.reward += parameters.reward_step;
        if endless {
            transition.terminated |= self.endless.spend_stamina();
        }
        self.steps += 1;
        transition.terminated |= self.steps == parameters.max_steps;
        transition
    }

    /// Moves the agent, or returns it to the start after a fall.
    fn move_agent(&mut self, config: &Config, action: &[i32]) {
        const BOUNDS: Bounds = (0, 0, SCREEN as i32, SCREEN as i32);
        let (speed, radius) = (config.parameters.agent_speed, config.agent.radius);
        if self.off_path {
            self.agent.position = self.origin(config);
        }
        match config.variant {
            Variant::Free => {
                let action = if self.off_path { &[0, 0] } else { action };
                self.agent.step_within(action, speed, radius, BOUNDS);
            }
            Variant::Grid if self.off_path => {}
            Variant::Grid => {
                let (x, y) = self.agent.step_on_grid(action[0], self.tile, GRID);
                self.agent.position = (x * TILE + TILE / 2, y * TILE + TILE / 2);
            }
            Variant::Endless if self.off_path => self.endless.scroll_back(config),
            Variant::Endless => {
                // Nothing, right, up, down.
                const MOVES: [[i32; 2]; 4] = [[0, 0], [2, 0], [0, 1], [0, 2]];
                let (x, _) = self.agent.step(&MOVES[action[0] as usize], speed);
                self.endless.scroll(x);
            }
        }
    }

    /// Checks whether the agent is on the path: rewards a new tile, or records a fall.
    fn check_tile(&mut self, config: &Config, transition: &mut Transition) {
        let parameters = &config.parameters;
        let visit = self.route.visit(self.tile);
        self.off_path = visit.is_none();
        self.cross = None;
        let Some(visit) = visit else {
            transition.reward += parameters.reward_fall_off;
            self.fails += 1;
            if parameters.visual_feedback {
                self.cross = Some(self.endless.on_screen(self.agent.position));
            }
            if config.variant == Variant::Endless {
                transition.terminated |= self.endless.fall(self.tile, parameters.stamina_level);
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
            self.endless.stamina = parameters.stamina_level;
        }
        if config.variant == Variant::Endless {
            self.endless.arrive(self.tile, &self.route);
        }
    }
}
