//! The reset parameters of Searing Spotlights as typed values, their limits, and the variants of its ids.
//!
//! Source: `default_reset_parameters` of the original.

use endless_gym_core::envs::ResetParameters;

/// Distinguishes the ids of Searing Spotlights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Variant {
    /// Whether a collected coin is replaced by a new one. There is then no exit.
    pub endless: bool,
}

/// Maximum number of spotlights at a time. The original has no limit; here a spotlight that is due waits until another one
/// leaves.
pub const MAX_SPOTLIGHTS: usize = 1000;

/// Maximum number of coins at a time.
pub const MAX_COINS: usize = 100;

/// Maximum size of the agent.
pub const MAX_AGENT_SCALE: f64 = 4.0;

/// Maximum radius of a spotlight in pixels: more than the screen's diagonal.
pub const MAX_SPOT_RADIUS: i32 = 256;

/// One set of reset parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    /// Maximum steps per episode; unlimited if less than 1.
    pub max_steps: i64,
    /// Steps within which the agent must collect the endless id's coin; not limited if less than 1.
    pub steps_per_coin: i64,
    /// Spotlights at the start of an episode, 0 to 1000.
    pub initial_spawns: usize,
    /// Spotlights that appear during an episode; not limited in the endless id.
    pub num_spawns: i64,
    /// Steps between two new spotlights.
    pub spawn_interval: i64,
    /// Minimum radius of a spotlight in pixels, 0 to 256; truncated.
    pub spot_min_radius: f64,
    /// Maximum radius of a spotlight in pixels, 0 to 256; truncated.
    pub spot_max_radius: f64,
    /// Minimum speed of a spotlight: the share of its path per step.
    pub spot_min_speed: f64,
    /// Maximum speed of a spotlight: the share of its path per step.
    pub spot_max_speed: f64,
    /// Health points lost per step in the light of spotlights.
    pub spot_damage: f64,
    /// Whether the background turns red while the agent is in a spotlight.
    pub visual_feedback: bool,
    /// Whether the background is black, and spotlights have a white outline.
    pub black_background: bool,
    /// Whether the background is plain white.
    pub hide_chessboard: bool,
    /// Increase of the darkness (0 to 255) per step; `None` if it is `light_threshold` from the start.
    pub dimming: Option<i32>,
    /// Darkness at which dimming stops, 0 to 255.
    pub light_threshold: i32,
    /// Number of coins, to draw from; 0 or 1 for the endless id.
    pub num_coins: Vec<i64>,
    /// Size of a coin; 1 is a radius of 10 pixels.
    pub coin_scale: f64,
    /// Steps that a new coin is visible in the dark.
    pub coin_show_duration: i64,
    /// Whether coins are visible in the dark.
    pub coins_visible: bool,
    /// Whether the agent must leave by an exit. False for the endless id.
    pub use_exit: bool,
    /// Size of the exit; 1 is a side of 20 pixels.
    pub exit_scale: f64,
    /// Whether the exit is visible in the dark.
    pub exit_visible: bool,
    /// Pixels per step, 0 to 84.
    pub agent_speed: f64,
    /// Health points of the agent at the start of an episode.
    pub agent_health: f64,
    /// Size of the agent; 0.25 is a radius of 6 pixels.
    pub agent_scale: f64,
    /// Whether the agent is visible in the dark.
    pub agent_visible: bool,
    /// Whether the agent starts at a random position; otherwise in the middle.
    pub sample_agent_position: bool,
    /// Whether the bar shows the previous action.
    pub show_last_action: bool,
    /// Whether the bar shows that the previous step gave a positive reward.
    pub show_last_positive_reward: bool,
    /// Reward for each step in a spotlight.
    pub reward_inside_spotlight: f64,
    /// Reward for each step outside all spotlights.
    pub reward_outside_spotlight: f64,
    /// Reward for losing all health points.
    pub reward_death: f64,
    /// Reward for leaving by the open exit.
    pub reward_exit: f64,
    /// Reward for collecting a coin.
    pub reward_coin: f64,
}

impl Parameters {
    /// Reads the parameters of the family from a checked set.
    pub fn new(variant: Variant, given: &ResetParameters) -> Self {
        let dim_off = given.int("light_dim_off_duration", 6);
        // The original computes a list of decreasing intervals, but always uses the first one.
        let first_interval = given.int("initial_spawn_interval", 30) + given.int("spawn_interval_threshold", 10);
        let coins = i64::from(given.bool("coin_enabled", true));
        Parameters {
            max_steps: given.int("max_steps", -1),
            steps_per_coin: given.int("steps_per_coin", -1),
            initial_spawns: given.int("initial_spawns", 4) as usize,
            num_spawns: given.int("num_spawns", i64::MAX),
            spawn_interval: given.int("spawn_interval", first_interval),
            spot_min_radius: given.float("spot_min_radius", 7.5),
            spot_max_radius: given.float("spot_max_radius", 13.75),
            spot_min_speed: given.float("spot_min_speed", 0.0025),
            spot_max_speed: given.float("spot_max_speed", 0.0075),
            spot_damage: given.float("spot_damage", 1.0),
            visual_feedback: given.bool("visual_feedback", true),
            black_background: given.bool("black_background", false),
            hide_chessboard: given.bool("hide_chessboard", false),
            dimming: (dim_off > 0).then(|| (255 / dim_off) as i32),
            light_threshold: given.int("light_threshold", 255) as i32,
            num_coins: if variant.endless { vec![coins] } else { given.int_list("num_coins") },
            coin_scale: given.float("coin_scale", 0.375),
            coin_show_duration: given.int("coin_show_duration", 0),
            coins_visible: given.bool("coins_visible", false),
            use_exit: given.bool("use_exit", false),
            exit_scale: given.float("exit_scale", 0.5),
            exit_visible: given.bool("exit_visible", false),
            agent_speed: given.float("agent_speed", 3.0),
            agent_health: given.float("agent_health", 5.0),
            agent_scale: given.float("agent_scale", 0.25),
            agent_visible: given.bool("agent_visible", false),
            sample_agent_position: given.bool("sample_agent_position", true),
            show_last_action: given.bool("show_last_action", true),
            show_last_positive_reward: given.bool("show_last_positive_reward", true),
            reward_inside_spotlight: given.float("reward_inside_spotlight", 0.0),
            reward_outside_spotlight: given.float("reward_outside_spotlight", 0.0),
            reward_death: given.float("reward_death", 0.0),
            reward_exit: given.float("reward_exit", 0.0),
            reward_coin: given.float("reward_coin", 0.25),
        }
    }
}
