//! The rules of Searing Spotlights: one implementation for both ids.
//!
//! Source: `reset` and `step` of the original's `searing_spotlights.py` and `endless_searing_spotlights.py`. The order of the
//! random draws is part of the rules.

use super::config::{BAR_HEIGHT, Config};
use super::parameters::{MAX_SPOTLIGHTS, Parameters};
use super::position_sampler::PositionSampler;
use super::spotlight::Spotlight;
use super::state::{Background, Exit, SPAWN_MARGIN, State};
use crate::character::{Bounds, Character};
use crate::screen::SCREEN;
use crate::vector::distance;
use endless_gym_core::envs::Transition;
use endless_gym_core::random::Generator;

const WALKABLE: Bounds = (0, BAR_HEIGHT as i32, SCREEN as i32, SCREEN as i32);

/// Minimum distances in pixels from the agent, from coins and exit, and between two coins of the endless id.
const AGENT_SPACE: i32 = 28;
const OBJECT_SPACE: i32 = 21;
const ENDLESS_COIN_SPACE: i32 = 28;

impl State {
    /// Starts an episode.
    pub(super) fn reset(&mut self, config: &Config, random: &mut Generator) {
        let parameters = &config.parameters;
        if !self.first_frame {
            self.former_agent = Some(self.agent);
        }
        self.first_frame = true;
        self.steps = 0;
        self.coin_steps = 0;
        self.success = false;
        self.hit = false;
        self.health = parameters.agent_health;
        self.red_columns = 0;
        self.last_action = [0, 0];
        self.shown_action = [0, 0];
        self.last_reward_positive = false;
        self.shown_reward_positive = false;
        if parameters.hide_chessboard {
            self.backgrounds = [Background::White; 2];
        }
        self.update_background(parameters);

        let mut sampler = PositionSampler::new();
        let rotation = random.integers(0, 8) as i32 * 45;
        let centre = (SCREEN / 2) as i32;
        let position = if parameters.sample_agent_position {
            near(sampler.sample(AGENT_SPACE, random), random)
        } else {
            sampler.block((centre, centre), OBJECT_SPACE);
            (centre, centre)
        };
        self.agent = Character { position, rotation };

        self.darkness = match parameters.dimming {
            Some(_) => 0,
            None => parameters.light_threshold as u8,
        };
        self.spotlights.clear();
        self.spotlights.reserve(config.typical_spotlights);
        self.lit.reserve(config.typical_spotlights.saturating_sub(self.lit.len()));
        self.spawn_timer = 0;
        self.spawns_left = parameters.num_spawns;
        self.spotlights.extend((0..parameters.initial_spawns).map(|_| Spotlight::spawn(parameters, random)));

        self.coins.clear();
        self.coins_collected = 0;
        self.num_coins = *random.choice(&parameters.num_coins) as usize;
        self.exit = None;
        if config.variant.endless {
            if self.num_coins > 0 {
                self.coins.push(next_coin(None, random));
            }
            return;
        }
        for _ in 0..self.num_coins {
            self.coins.push(object_position(&mut sampler, OBJECT_SPACE, random));
        }
        if parameters.use_exit {
            self.exit = Some(Exit { location: object_position(&mut sampler, OBJECT_SPACE, random), open: false });
        }
    }

    /// Plays one step.
    pub(super) fn step(&mut self, config: &Config, action: &[i32], random: &mut Generator) -> Transition {
        let parameters = &config.parameters;
        self.first_frame = false;
        self.agent.step_within(action, parameters.agent_speed, config.agent.radius, WALKABLE);
        self.shown_action = self.last_action;
        self.last_action = [action[0], action[1]];
        self.dim_light(parameters);

        let mut reward = self.advance_spotlights(config, random);
        let mut terminated = self.health <= 0.0;
        if terminated {
            reward += parameters.reward_death;
        }
        // Each sum starts at zero, as in the original, since the order of additions determines the rounding.
        reward +=
            if config.variant.endless { self.collect_endless_coin(config, random) } else { self.collect_coins(config) };
        let coins_done = self.coins.is_empty();
        let mut left = false;
        if let Some(exit) = self.exit.as_mut().filter(|_| coins_done) {
            exit.open = true;
            left = reaches(exit.location, self.agent, config.exit_radius + f64::from(config.agent.radius));
            reward += if left { parameters.reward_exit } else { 0.0 };
        }
        let all_collected = coins_done && self.num_coins > 0 && !parameters.use_exit && !config.variant.endless;
        self.success = !terminated && (left || all_collected);
        terminated |= self.success;

        self.steps += 1;
        self.coin_steps += 1;
        terminated |= self.steps == parameters.max_steps;
        terminated |= self.num_coins > 0 && self.coin_steps == parameters.steps_per_coin;

        self.shown_reward_positive = self.last_reward_positive;
        self.last_reward_positive = reward > 0.0;
        Transition { reward, terminated, truncated: false }
    }

    /// Increases the darkness until it exceeds the threshold.
    fn dim_light(&mut self, parameters: &Parameters) {
        let darkness = i32::from(self.darkness);
        if darkness <= parameters.light_threshold {
            let darker = parameters.dimming.map_or(parameters.light_threshold, |dimming| darkness + dimming);
            self.darkness = darker.min(255) as u8;
        }
    }

    /// Spawns and moves the spotlights, and damages the agent if they touch it. Returns the reward.
    fn advance_spotlights(&mut self, config: &Config, random: &mut Generator) -> f64 {
        let parameters = &config.parameters;
        self.spawn_timer += 1;
        let due = self.spawns_left > 0 && self.spawn_timer >= parameters.spawn_interval;
        if due && self.spotlights.len() < MAX_SPOTLIGHTS {
            self.spotlights.push(Spotlight::spawn(parameters, random));
            self.spawns_left -= 1;
            self.spawn_timer = 0;
        }

        self.lit.clear();
        self.outlined = parameters.black_background;
        self.hit = false;
        let agent = centre(self.agent);
        let mut index = 0;
        while let Some(spotlight) = self.spotlights.get_mut(index) {
            if spotlight.done {
                // The next one takes its index and is skipped: it neither moves nor shines in this step.
                self.spotlights.remove(index);
            } else {
                spotlight.advance();
                self.lit.push(spotlight.circle());
                let reach = spotlight.radius + config.agent.radius;
                self.hit |= distance(spotlight.location, agent) <= f64::from(reach);
            }
            index += 1;
        }
        if self.hit {
            self.health -= parameters.spot_damage;
            let lost = (SCREEN / 2) as f64 * (1.0 - self.health_share(parameters));
            // pygame keeps the low 32 bits of a width, and paints nothing for a negative width.
            let width = (lost as i64 as i32).clamp(0, SCREEN as i32);
            self.red_columns = self.red_columns.max(width as u8);
        }
        self.update_background(parameters);
        if self.hit { parameters.reward_inside_spotlight } else { parameters.reward_outside_spotlight }
    }

    /// Selects the background, and replaces it permanently with black if the parameters say so.
    fn update_background(&mut self, parameters: &Parameters) {
        let background = &mut self.backgrounds[usize::from(self.hit && parameters.visual_feedback)];
        if parameters.black_background {
            *background = Background::Black;
        }
        self.background = *background;
    }

    /// Collects the coins that the agent reaches. Returns the reward.
    fn collect_coins(&mut self, config: &Config) -> f64 {
        let reach = f64::from(config.coin_radius + config.agent.radius);
        let mut reward = 0.0;
        let mut index = 0;
        while let Some(&coin) = self.coins.get(index) {
            if reaches(coin, self.agent, reach) {
                // The next one is skipped, as with spotlights.
                self.coins.remove(index);
                self.coins_collected += 1;
                reward += config.parameters.reward_coin;
            }
            index += 1;
        }
        reward
    }

    /// Replaces the only coin with a new one if the agent reaches it. Returns the reward.
    fn collect_endless_coin(&mut self, config: &Config, random: &mut Generator) -> f64 {
        let reach = f64::from(config.coin_radius + config.agent.radius);
        match self.coins.first_mut() {
            Some(coin) if reaches(*coin, self.agent, reach) => {
                *coin = next_coin(Some(*coin), random);
                self.coins_collected += 1;
                self.coin_steps = 0;
                config.parameters.reward_coin
            }
            _ => 0.0,
        }
    }
}

fn centre(agent: Character) -> [f64; 2] {
    [f64::from(agent.position.0), f64::from(agent.position.1)]
}

/// Whether the agent is within `reach` pixels of a position.
fn reaches((x, y): (i32, i32), agent: Character, reach: f64) -> bool {
    distance([f64::from(x), f64::from(y)], centre(agent)) <= reach
}

/// A random position two or three pixels to the right of and below another.
fn near((x, y): (i32, i32), random: &mut Generator) -> (i32, i32) {
    (x + random.integers(2, 4) as i32, y + random.integers(2, 4) as i32)
}

/// Draws a position for a coin or the exit.
fn object_position(sampler: &mut PositionSampler, space: i32, random: &mut Generator) -> (i32, i32) {
    let (x, y) = near(sampler.sample(space, random), random);
    let within = |coordinate: i32| coordinate.clamp(SPAWN_MARGIN, SCREEN as i32 - SPAWN_MARGIN);
    (within(x), within(y))
}

/// Draws a position for the endless id's next coin, away from the last one.
fn next_coin(last: Option<(i32, i32)>, random: &mut Generator) -> (i32, i32) {
    let mut sampler = PositionSampler::new();
    if let Some(coin) = last {
        sampler.block(coin, ENDLESS_COIN_SPACE);
    }
    object_position(&mut sampler, ENDLESS_COIN_SPACE, random)
}
