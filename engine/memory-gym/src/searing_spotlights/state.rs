//! The state of a Searing Spotlights environment.

use serde::{Deserialize, Serialize};

use super::circles::Circle;
use super::config::{BAR_HEIGHT, Config};
use super::parameters::{MAX_SPOTLIGHTS, Parameters};
use super::spotlight::Spotlight;
use crate::character::{Character, CharacterSize};
use crate::controls::MAX_AGENT_SCALE;
use crate::screen::SCREEN;
use endless_gym_core::envs::Progress;

/// Minimum distance in pixels between the centres of coins and exit and the screen's border.
pub(super) const SPAWN_MARGIN: i32 = 7;

/// The background of the screen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Background {
    /// White and blue tiles.
    #[default]
    Blue,
    /// White and red tiles.
    Red,
    /// Plain white.
    White,
    /// Plain black.
    Black,
}

/// Everything that changes during play.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct State {
    pub(super) agent: Character,
    /// The previous episode's agent, which the ground-truth view shows until the first step of an episode.
    pub(super) former_agent: Option<Character>,
    /// Whether the frame is the first of its episode.
    pub(super) first_frame: bool,
    pub(super) health: f64,
    /// Red columns of the health bar; more than [`HEALTH_WIDTH`](super::config::HEALTH_WIDTH) for negative health.
    pub(super) red_columns: u8,
    pub(super) spotlights: Vec<Spotlight>,
    pub(super) spawn_timer: i64,
    pub(super) spawns_left: i64,
    /// The circles that the spotlights lit in the last step, in drawing order. An episode starts with those of the previous
    /// one.
    pub(super) lit: Vec<Circle>,
    /// Whether the lit circles have outlines.
    pub(super) outlined: bool,
    /// Darkness outside the lit circles, 0 to 255.
    pub(super) darkness: u8,
    /// Centres of the coins that are left.
    pub(super) coins: Vec<(i32, i32)>,
    /// Number of coins at the start of the episode.
    pub(super) num_coins: usize,
    pub(super) coins_collected: u32,
    pub(super) exit: Option<Exit>,
    pub(super) last_action: [i32; 2],
    /// The action of the last step but one, which the bar shows.
    pub(super) shown_action: [i32; 2],
    pub(super) last_reward_positive: bool,
    /// Whether the last step but one gave a positive reward, which the bar shows.
    pub(super) shown_reward_positive: bool,
    /// Whether a spotlight touched the agent in the last step.
    pub(super) hit: bool,
    /// The backgrounds without and with a hit. As in the original, a replaced background stays replaced in later episodes.
    pub(super) backgrounds: [Background; 2],
    /// The current background.
    pub(super) background: Background,
    pub(super) steps: i64,
    /// Steps since the endless id's coin appeared.
    pub(super) coin_steps: i64,
    pub(super) success: bool,
}

/// The exit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Exit {
    /// Centre in pixels.
    pub location: (i32, i32),
    /// Whether the agent can leave by it.
    pub open: bool,
}

impl State {
    /// The state before the first reset.
    pub(super) fn new() -> Self {
        let backgrounds = [Background::Blue, Background::Red];
        State { first_frame: true, backgrounds, ..State::default() }
    }

    /// Whether an environment can be in this state. A forged snapshot may hold any numbers.
    pub(super) fn is_valid(&self, config: &Config) -> bool {
        let parameters = &config.parameters;
        // An agent may start a little off the screen, and a large one stays below the bar.
        let end = |radius: i32| (SCREEN as i32 + 2).max(BAR_HEIGHT as i32 + radius);
        let is_within = |agent: &Character, end| {
            agent.is_valid()
                && agent.position.0.min(agent.position.1) >= 0
                && agent.position.0.max(agent.position.1) <= end
        };
        let margins = SPAWN_MARGIN..=SCREEN as i32 - SPAWN_MARGIN;
        let collected = if config.variant.endless { 0 } else { self.coins_collected as usize };
        is_within(&self.agent, end(config.agent.radius))
            && self.former_agent.is_none_or(|agent| is_within(&agent, end(CharacterSize::new(MAX_AGENT_SCALE).radius)))
            && self.health.is_finite()
            && self.health <= parameters.agent_health
            && usize::from(self.red_columns) <= SCREEN
            && self.spotlights.len() <= MAX_SPOTLIGHTS
            && self.spotlights.iter().all(|spotlight| spotlight.is_valid(parameters))
            && self.lit.len() <= MAX_SPOTLIGHTS
            && self.lit.iter().all(Circle::is_valid)
            && parameters.num_coins.contains(&(self.num_coins as i64))
            && self.coins.len().checked_add(collected) == Some(self.num_coins)
            && self.exit.is_some() == parameters.use_exit
            && self.exit.is_none_or(|exit| !exit.open || self.coins.is_empty())
            && self
                .coins
                .iter()
                .copied()
                .chain(self.exit.map(|exit| exit.location))
                .all(|(x, y)| margins.contains(&x) && margins.contains(&y))
            && self.last_action.iter().chain(&self.shown_action).all(|branch| (0..3).contains(branch))
            && (0..i64::MAX / 2).contains(&self.steps)
            && self.first_frame == (self.steps == 0)
            && (!config.variant.endless || i64::from(self.coins_collected) <= self.steps.min(i64::from(u32::MAX / 2)))
            && (0..=parameters.num_spawns).contains(&self.spawns_left)
            && [self.spawn_timer, self.coin_steps].iter().all(|count| (0..=self.steps).contains(count))
    }

    /// Whether coins are visible in the dark.
    pub(super) fn coins_visible(&self, parameters: &Parameters) -> bool {
        parameters.coins_visible || self.coin_steps < parameters.coin_show_duration
    }

    /// The share of health points that is left.
    pub(super) fn health_share(&self, parameters: &Parameters) -> f64 {
        self.health / parameters.agent_health
    }

    /// Number of coins, and health points.
    pub(super) fn progress(&self, config: &Config) -> Vec<Progress> {
        let coins = self.coins_collected;
        let coins = match config.variant.endless {
            true => Progress::count("coins", coins),
            false => Progress::share("coins", coins, self.num_coins as f64),
        };
        vec![coins, Progress::share("health", self.health, config.parameters.agent_health)]
    }

    /// The final info of the finite id: share of health, share of coins, success, task progress. The share of coins is NaN without
    /// coins, as in the original.
    pub(super) fn finite_info(&self, parameters: &Parameters) -> [f64; 4] {
        let (coins, success) =
            (f64::from(self.coins_collected) / self.num_coins as f64, f64::from(u8::from(self.success)));
        let collected = if self.num_coins == 0 { 1.0 } else { coins };
        let progress = if parameters.use_exit { (collected + success) / 2.0 } else { collected };
        [self.health_share(parameters), coins, success, progress]
    }

    /// The final info of the endless id: share of health, number of coins.
    pub(super) fn endless_info(&self, parameters: &Parameters) -> [f64; 2] {
        [self.health_share(parameters), f64::from(self.coins_collected)]
    }

    /// Positions of agent and coin, as shares of the screen's size; (0, 0) without a coin.
    pub(super) fn ground_truth(&self) -> [f64; 4] {
        let (x, y) = self.agent.position;
        let (coin_x, coin_y) = self.coins.first().copied().unwrap_or_default();
        [x, y, coin_x, coin_y].map(|pixels| f64::from(pixels) / SCREEN as f64)
    }
}
