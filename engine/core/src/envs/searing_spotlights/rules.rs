//! The rules of Searing Spotlights: one set for both ids.
//!
//! Source: `reset` and `step` of the original's `searing_spotlights.py` and `endless_searing_spotlights.py`. The order of the
//! random draws is part of the rules.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::drawing::{Assets, Ground};
use super::parameters::{MAX_SPOT_RADIUS, MAX_SPOTLIGHTS, Parameters};
use super::spawning::Places;
use super::spotlight::{Circle, Spotlight};
use crate::envs::character::{Bounds, Character};
use crate::envs::vector::distance;
use crate::envs::{SCREEN, Transition};
use crate::random::Generator;

/// Height in pixels of the bar at the top of the screen, which the agent does not walk on.
pub(super) const BAR_HEIGHT: usize = 4;

const WALKABLE: Bounds = (0, BAR_HEIGHT as i32, SCREEN as i32, SCREEN as i32);

/// Pixels from the screen's corner that nothing ever is away.
pub(super) const FAR: u32 = 1 << 13;

/// Pixels that coins and exit keep between their centres and the screen's border.
const SPAWN_MARGIN: i32 = 7;

/// Pixels around a new agent, coin or exit that are kept free of the next; the endless id keeps its coins farther apart.
const AGENT_SPACE: i32 = 28;
const OBJECT_SPACE: i32 = 21;
const ENDLESS_COIN_SPACE: i32 = 28;

/// One environment.
#[derive(Clone, Debug)]
pub struct SearingSpotlights {
    pub(super) assets: Arc<Assets>,
    pub(super) state: State,
}

/// Everything about an environment that changes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct State {
    pub(super) agent: Character,
    /// What the ground-truth view goes on showing until the first step of an episode: the agent of the episode before.
    pub(super) former_agent: Option<Character>,
    /// The frame is the first of its episode.
    pub(super) first_frame: bool,
    pub(super) health: f64,
    /// Columns of the health bar that have turned red; beyond its half of the screen for health below zero.
    pub(super) red_columns: u8,
    pub(super) spotlights: Vec<Spotlight>,
    spawn_timer: i64,
    spawns_left: i64,
    /// What the spotlights lit in the last step, in the order in which they shine; an episode starts with what the one before
    /// left behind.
    pub(super) lit: Vec<Circle>,
    /// The lit circles have outlines.
    pub(super) outlined: bool,
    /// How dark the screen is outside of the lit circles, 0 to 255.
    pub(super) darkness: u8,
    /// Centres of the coins that are there.
    pub(super) coins: Vec<(i32, i32)>,
    num_coins: usize,
    coins_collected: u32,
    pub(super) exit: Option<Exit>,
    /// The action of the last step, and the one before it, which the bar shows.
    last_action: [i32; 2],
    pub(super) shown_action: [i32; 2],
    /// Whether the last step gave a positive reward, and whether the one before it did, which the bar shows.
    last_reward_positive: bool,
    pub(super) shown_reward_positive: bool,
    /// Spotlights met the agent in the last step.
    pub(super) hit: bool,
    /// The background while the agent is unseen and while it is seen. Once painted over, it stays that way, as in the original.
    grounds: [Ground; 2],
    pub(super) ground: Ground,
    steps: i64,
    /// Steps since the endless id's coin appeared.
    coin_steps: i64,
    success: bool,
}

/// The way out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Exit {
    /// Its centre.
    pub location: (i32, i32),
    pub open: bool,
}

impl State {
    pub(super) fn unplayed() -> Self {
        State {
            agent: Character::default(),
            former_agent: None,
            first_frame: true,
            health: 0.0,
            red_columns: 0,
            spotlights: Vec::new(),
            spawn_timer: 0,
            spawns_left: 0,
            lit: Vec::new(),
            outlined: false,
            darkness: 0,
            coins: Vec::new(),
            num_coins: 0,
            coins_collected: 0,
            exit: None,
            last_action: [0, 0],
            shown_action: [0, 0],
            last_reward_positive: false,
            shown_reward_positive: false,
            hit: false,
            grounds: [Ground::Blue, Ground::Red],
            ground: Ground::Blue,
            steps: 0,
            coin_steps: 0,
            success: false,
        }
    }

    /// Whether playing on from the state stays within the rules: every number in its range.
    pub(super) fn is_valid(&self) -> bool {
        let near = |(x, y): (i32, i32)| x.unsigned_abs() < FAR && y.unsigned_abs() < FAR;
        self.agent.is_valid()
            && self.former_agent.is_none_or(|agent| agent.is_valid())
            && self.health.is_finite()
            && usize::from(self.red_columns) <= SCREEN
            && self.spotlights.len() <= MAX_SPOTLIGHTS
            && self.spotlights.iter().all(Spotlight::is_valid)
            && self.lit.len() <= MAX_SPOTLIGHTS
            && self
                .lit
                .iter()
                .all(|circle| near(circle.centre()) && (0..=MAX_SPOT_RADIUS).contains(&circle.radius.into()))
            && self.coins.iter().copied().chain(self.exit.map(|exit| exit.location)).all(near)
            && self.last_action.iter().chain(&self.shown_action).all(|branch| (0..3).contains(branch))
            && self.coins_collected < u32::MAX / 2
            // Without a limit it is the largest number there is.
            && self.spawns_left >= 0
            && [self.spawn_timer, self.steps, self.coin_steps].iter().all(|count| (0..i64::MAX / 2).contains(count))
    }

    pub(super) fn start(&mut self, assets: &Assets, random: &mut Generator) {
        let parameters = &assets.parameters;
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
            self.grounds = [Ground::White; 2];
        }
        self.lay_ground(parameters);

        let mut places = Places::new();
        let rotation = random.integers(0, 8) as i32 * 45;
        let centre = (SCREEN / 2) as i32;
        let position = if parameters.sample_agent_position {
            near(places.sample(AGENT_SPACE, random), random)
        } else {
            places.block((centre, centre), OBJECT_SPACE);
            (centre, centre)
        };
        self.agent = Character { position, rotation };

        self.darkness = match parameters.dimming {
            Some(_) => 0,
            None => parameters.light_threshold as u8,
        };
        self.spotlights.clear();
        self.spotlights.reserve(assets.most_spotlights);
        self.lit.reserve(assets.most_spotlights.saturating_sub(self.lit.len()));
        self.spawn_timer = 0;
        self.spawns_left = parameters.num_spawns;
        self.spotlights.extend((0..parameters.initial_spawns).map(|_| Spotlight::spawn(parameters, random)));

        self.coins.clear();
        self.coins_collected = 0;
        self.num_coins = *random.choice(&parameters.num_coins) as usize;
        self.exit = None;
        if assets.variant.endless {
            if self.num_coins > 0 {
                self.coins.push(next_coin(None, random));
            }
            return;
        }
        for _ in 0..self.num_coins {
            self.coins.push(object_place(&mut places, OBJECT_SPACE, random));
        }
        if parameters.use_exit {
            self.exit = Some(Exit { location: object_place(&mut places, OBJECT_SPACE, random), open: false });
        }
    }

    pub(super) fn play(&mut self, assets: &Assets, action: &[i32], random: &mut Generator) -> Transition {
        let parameters = &assets.parameters;
        self.first_frame = false;
        self.agent.step_within(action, parameters.agent_speed, assets.agent_radius(), WALKABLE);
        self.shown_action = self.last_action;
        self.last_action = [action[0], action[1]];
        self.dim_light(parameters);

        let mut reward = self.burn(assets, random);
        let mut terminated = self.health <= 0.0;
        if terminated {
            reward += parameters.reward_death;
        }
        // Each sum starts at zero, as in the original: the order of the additions decides how they are rounded.
        reward += if assets.variant.endless { self.collect_for_ever(assets, random) } else { self.collect(assets) };
        let coins_done = self.coins.is_empty();
        let mut left = false;
        if let Some(exit) = self.exit.as_mut().filter(|_| coins_done) {
            exit.open = true;
            left = reaches(exit.location, self.agent, assets.exit_radius + f64::from(assets.agent_radius()));
            reward += if left { parameters.reward_exit } else { 0.0 };
        }
        let all_collected = coins_done && self.num_coins > 0 && !parameters.use_exit && !assets.variant.endless;
        self.success = !terminated && (left || all_collected);
        terminated |= self.success;

        self.steps += 1;
        self.coin_steps += 1;
        terminated |= self.steps == parameters.max_steps;
        terminated |= self.num_coins > 0 && self.coin_steps == parameters.steps_per_coin;

        self.shown_reward_positive = self.last_reward_positive;
        self.last_reward_positive = reward > 0.0;
        Transition { reward, terminated }
    }

    /// Makes the screen darker until it is dark enough.
    fn dim_light(&mut self, parameters: &Parameters) {
        let darkness = i32::from(self.darkness);
        if darkness <= parameters.light_threshold {
            let darker = parameters.dimming.map_or(parameters.light_threshold, |dimming| darkness + dimming);
            self.darkness = darker.min(255) as u8;
        }
    }

    /// Sends the spotlights on, and burns the agent where they meet it. Returns the reward.
    fn burn(&mut self, assets: &Assets, random: &mut Generator) -> f64 {
        let parameters = &assets.parameters;
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
                // The next one takes its place and is skipped: for this step it stands still in the dark.
                self.spotlights.remove(index);
            } else {
                spotlight.advance();
                self.lit.push(spotlight.circle());
                let reach = spotlight.radius + assets.agent_radius();
                self.hit |= distance(spotlight.location, agent) <= f64::from(reach);
            }
            index += 1;
        }
        if self.hit {
            self.health -= parameters.spot_damage;
            let lost = (SCREEN / 2) as f64 * (1.0 - self.health_share(parameters));
            // pygame keeps a width's low 32 bits, and paints no rectangle for a negative one.
            let width = (lost as i64 as i32).clamp(0, SCREEN as i32);
            self.red_columns = self.red_columns.max(width as u8);
        }
        self.lay_ground(parameters);
        if self.hit { parameters.reward_inside_spotlight } else { parameters.reward_outside_spotlight }
    }

    /// Chooses the background, and paints it over if it is to be black.
    fn lay_ground(&mut self, parameters: &Parameters) {
        let ground = &mut self.grounds[usize::from(self.hit && parameters.visual_feedback)];
        if parameters.black_background {
            *ground = Ground::Black;
        }
        self.ground = *ground;
    }

    /// The agent collects the coins that it reaches. Returns the reward.
    fn collect(&mut self, assets: &Assets) -> f64 {
        let reach = f64::from(assets.coin_radius + assets.agent_radius());
        let mut reward = 0.0;
        let mut index = 0;
        while let Some(&coin) = self.coins.get(index) {
            if reaches(coin, self.agent, reach) {
                // As with the spotlights, the next one is skipped.
                self.coins.remove(index);
                self.coins_collected += 1;
                reward += assets.parameters.reward_coin;
            }
            index += 1;
        }
        reward
    }

    /// The agent collects the only coin if it reaches it, and another appears. Returns the reward.
    fn collect_for_ever(&mut self, assets: &Assets, random: &mut Generator) -> f64 {
        let reach = f64::from(assets.coin_radius + assets.agent_radius());
        match self.coins.first_mut() {
            Some(coin) if reaches(*coin, self.agent, reach) => {
                *coin = next_coin(Some(*coin), random);
                self.coins_collected += 1;
                self.coin_steps = 0;
                assets.parameters.reward_coin
            }
            _ => 0.0,
        }
    }

    /// Whether coins are seen in the dark.
    pub(super) fn coins_shine(&self, parameters: &Parameters) -> bool {
        parameters.coins_visible || self.coin_steps < parameters.coin_show_duration
    }

    /// The share of health points that is left.
    pub(super) fn health_share(&self, parameters: &Parameters) -> f64 {
        self.health / parameters.agent_health
    }

    /// The final info of the finite id: health, share of coins, success.
    pub(super) fn finite_info(&self, parameters: &Parameters) -> [f64; 3] {
        // Not a number where there are no coins, as in the original.
        let coins = f64::from(self.coins_collected) / self.num_coins as f64;
        [self.health_share(parameters), coins, f64::from(u8::from(self.success))]
    }

    /// The final info of the endless id: health, number of coins.
    pub(super) fn endless_info(&self, parameters: &Parameters) -> [f64; 2] {
        [self.health_share(parameters), f64::from(self.coins_collected)]
    }

    /// Positions of agent and coin, as shares of the screen's size; (0, 0) for a coin that is not there.
    pub(super) fn ground_truth(&self) -> [f64; 4] {
        let (x, y) = self.agent.position;
        let (coin_x, coin_y) = self.coins.first().copied().unwrap_or_default();
        [x, y, coin_x, coin_y].map(|pixels| f64::from(pixels) / SCREEN as f64)
    }
}

fn centre(agent: Character) -> [f64; 2] {
    [f64::from(agent.position.0), f64::from(agent.position.1)]
}

/// Whether the agent is within `reach` pixels of a place.
fn reaches((x, y): (i32, i32), agent: Character, reach: f64) -> bool {
    distance([f64::from(x), f64::from(y)], centre(agent)) <= reach
}

/// A place two or three pixels to the right of and below a drawn one.
fn near((x, y): (i32, i32), random: &mut Generator) -> (i32, i32) {
    (x + random.integers(2, 4) as i32, y + random.integers(2, 4) as i32)
}

/// Draws a place for a coin or the exit.
fn object_place(places: &mut Places, space: i32, random: &mut Generator) -> (i32, i32) {
    let (x, y) = near(places.sample(space, random), random);
    let within = |coordinate: i32| coordinate.clamp(SPAWN_MARGIN, SCREEN as i32 - SPAWN_MARGIN);
    (within(x), within(y))
}

/// Draws a place for the endless id's next coin, away from the last one.
fn next_coin(last: Option<(i32, i32)>, random: &mut Generator) -> (i32, i32) {
    let mut places = Places::new();
    if let Some(coin) = last {
        places.block(coin, ENDLESS_COIN_SPACE);
    }
    object_place(&mut places, ENDLESS_COIN_SPACE, random)
}
