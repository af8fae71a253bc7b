//! The reset parameters of Searing Spotlights as typed values, their limits, and the variants of its ids.
//!
//! Source: `default_reset_parameters` of the original.

use crate::typed_parameters::{type_of, typed_parameters};
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

/// Maximum radius of a spotlight in pixels: more than the screen's diagonal.
pub const MAX_SPOT_RADIUS: i32 = 256;

typed_parameters! {
    variant, given;
    max_steps: int(-1),
    steps_per_coin: int(-1),
    num_spawns: int(i64::MAX),
    spot_min_radius: float(7.5),
    spot_max_radius: float(13.75),
    spot_min_speed: float(0.0025),
    spot_max_speed: float(0.0075),
    spot_damage: float(1.0),
    visual_feedback: bool(true),
    black_background: bool(false),
    hide_chessboard: bool(false),
    coin_scale: float(0.375),
    coin_show_duration: int(0),
    coins_visible: bool(false),
    use_exit: bool(false),
    exit_scale: float(0.5),
    exit_visible: bool(false),
    agent_speed: float(3.0),
    agent_health: float(5.0),
    agent_scale: float(0.25),
    agent_visible: bool(false),
    sample_agent_position: bool(true),
    show_last_action: bool(true),
    show_last_positive_reward: bool(true),
    reward_inside_spotlight: float(0.0),
    reward_outside_spotlight: float(0.0),
    reward_death: float(0.0),
    reward_exit: float(0.0),
    reward_coin: float(0.25),
    ;
    /// Spotlights at the start of an episode, 0 to 1000.
    initial_spawns: usize = given.int("initial_spawns", 4) as usize,
    /// Steps between two new spotlights. The original computes a list of decreasing intervals, but always uses the first one.
    spawn_interval: i64 = {
        let first = given.int("initial_spawn_interval", 30) + given.int("spawn_interval_threshold", 10);
        given.int("spawn_interval", first)
    },
    /// Increase of the darkness (0 to 255) per step; `None` if it is `light_threshold` from the start.
    dimming: Option<i32> = {
        let duration = given.int("light_dim_off_duration", 6);
        (duration > 0).then(|| (255 / duration) as i32)
    },
    /// Darkness at which dimming stops, 0 to 255.
    light_threshold: i32 = given.int("light_threshold", 255) as i32,
    /// Number of coins, to draw from; 0 or 1 for the endless id.
    num_coins: Vec<i64> = match variant.endless {
        true => vec![i64::from(given.bool("coin_enabled", true))],
        false => given.int_list("num_coins"),
    },
}
