//! The ids of Searing Spotlights, their reset parameters and their info columns.
//!
//! Source: `default_reset_parameters` of the original. The original checks no values. The limits here are wide enough for every
//! use, and narrow enough that no value breaks the rules, needs much memory or makes a step slow.

use super::features;
use super::parameters::{MAX_COINS, MAX_SPOT_RADIUS, MAX_SPOTLIGHTS, Variant};
use std::sync::LazyLock;

use crate::controls::{AGENT_SPEED, MAX_AGENT_SCALE, MOVE, column, float, integer, max_steps, spec};
use endless_gym_core::envs::{Column, EnvSpec, InfoColumn, Metric, OriginalTypes, Parameter};

const fn initial_spawns(default: i64) -> Parameter {
    Parameter::int("initial_spawns", default, 0, MAX_SPOTLIGHTS as i64, "Spotlights at the start of an episode.")
}

const fn agent_health(default: f64) -> Parameter {
    Parameter::float("agent_health", default, 0.001, 1e9, "Health points of the agent.")
}

const SPOT_MIN_RADIUS: Parameter = Parameter::float(
    "spot_min_radius",
    7.5,
    0.0,
    MAX_SPOT_RADIUS as f64,
    "Minimum radius of a spotlight in pixels, truncated.",
);
const SPOT_MAX_RADIUS: Parameter = Parameter::float(
    "spot_max_radius",
    13.75,
    0.0,
    MAX_SPOT_RADIUS as f64,
    "Maximum radius of a spotlight in pixels, truncated.",
);
const SPOT_MIN_SPEED: Parameter = Parameter::float(
    "spot_min_speed",
    0.0025,
    0.0,
    1e6,
    "Minimum speed of a spotlight: the share of its path per step.",
);
const SPOT_MAX_SPEED: Parameter = Parameter::float("spot_max_speed", 0.0075, 0.0, 1e6, "Maximum speed of a spotlight.");
const SPOT_DAMAGE: Parameter =
    Parameter::float("spot_damage", 1.0, 0.0, 1e9, "Health points lost per step in the light of spotlights.");
const VISUAL_FEEDBACK: Parameter =
    Parameter::bool("visual_feedback", true, "Whether the background turns red while the agent is in a spotlight.");
const BLACK_BACKGROUND: Parameter = Parameter::bool(
    "black_background",
    false,
    "Whether the background is black; spotlights then have a white outline.",
);
const HIDE_CHESSBOARD: Parameter = Parameter::bool("hide_chessboard", false, "Whether the background is plain white.");
const LIGHT_DIM_OFF_DURATION: Parameter = Parameter::int(
    "light_dim_off_duration",
    6,
    0,
    1_000_000,
    "Steps until the light is off; 0 for darkness from the start.",
);
const LIGHT_THRESHOLD: Parameter = Parameter::int(
    "light_threshold",
    255,
    0,
    255,
    "Darkness at which dimming stops; 255 is black. The last step of dimming may exceed it.",
);
const COIN_SCALE: Parameter =
    Parameter::float("coin_scale", 0.375, 0.0, 8.0, "Size of a coin; 1 is a radius of 10 pixels.");
const COINS_VISIBLE: Parameter = Parameter::bool("coins_visible", false, "Whether coins are visible in the dark.");
const AGENT_SCALE: Parameter =
    Parameter::float("agent_scale", 0.25, 0.0, MAX_AGENT_SCALE, "Size of the agent; 0.25 is a radius of 6 pixels.");
const AGENT_VISIBLE: Parameter = Parameter::bool("agent_visible", false, "Whether the agent is visible in the dark.");
const SAMPLE_AGENT_POSITION: Parameter = Parameter::bool(
    "sample_agent_position",
    true,
    "Whether the agent starts at a random position; otherwise in the middle.",
);
const SHOW_LAST_ACTION: Parameter =
    Parameter::bool("show_last_action", true, "Whether the bar at the top shows the previous action.");
const SHOW_LAST_POSITIVE_REWARD: Parameter = Parameter::bool(
    "show_last_positive_reward",
    true,
    "Whether the bar at the top shows that the previous step gave a positive reward.",
);
const REWARD_INSIDE_SPOTLIGHT: Parameter =
    Parameter::reward("reward_inside_spotlight", 0.0, "Reward for each step in a spotlight.");
const REWARD_OUTSIDE_SPOTLIGHT: Parameter =
    Parameter::reward("reward_outside_spotlight", 0.0, "Reward for each step outside all spotlights.");
const REWARD_DEATH: Parameter = Parameter::reward("reward_death", 0.0, "Reward for losing all health points.");
const REWARD_COIN: Parameter = Parameter::reward("reward_coin", 0.25, "Reward for collecting a coin.");

const SEARING_SPOTLIGHTS: &[Parameter] = &[
    max_steps(256),
    initial_spawns(4),
    Parameter::int("num_spawns", 30, 0, MAX_SPOTLIGHTS as i64, "Spotlights that appear during an episode."),
    Parameter::int(
        "initial_spawn_interval",
        30,
        0,
        1_000_000_000,
        "Steps between two new spotlights, in addition to `spawn_interval_threshold`.",
    ),
    Parameter::int("spawn_interval_threshold", 10, 0, 1_000_000_000, "Steps added to each interval."),
    Parameter::float(
        "spawn_interval_decay",
        0.95,
        0.0,
        1e6,
        "No effect, as in the original, where it was meant to shorten the interval.",
    ),
    SPOT_MIN_RADIUS,
    SPOT_MAX_RADIUS,
    SPOT_MIN_SPEED,
    SPOT_MAX_SPEED,
    SPOT_DAMAGE,
    VISUAL_FEEDBACK,
    BLACK_BACKGROUND,
    HIDE_CHESSBOARD,
    LIGHT_DIM_OFF_DURATION,
    LIGHT_THRESHOLD,
    Parameter::list("num_coins", &[1], 0, MAX_COINS as i64, "Number of coins. Each episode draws one from the list."),
    COIN_SCALE,
    COINS_VISIBLE,
    Parameter::bool(
        "use_exit",
        true,
        "Whether the agent must leave by an exit, which opens when all coins are collected.",
    ),
    Parameter::float("exit_scale", 0.5, 0.0, 8.0, "Size of the exit; 1 is a side of 20 pixels."),
    Parameter::bool("exit_visible", false, "Whether the exit is visible in the dark."),
    AGENT_SPEED,
    agent_health(5.0),
    AGENT_SCALE,
    AGENT_VISIBLE,
    SAMPLE_AGENT_POSITION,
    SHOW_LAST_ACTION,
    SHOW_LAST_POSITIVE_REWARD,
    REWARD_INSIDE_SPOTLIGHT,
    REWARD_OUTSIDE_SPOTLIGHT,
    REWARD_DEATH,
    Parameter::reward("reward_exit", 1.0, "Reward for leaving by the open exit."),
    Parameter::reward("reward_max_steps", 0.0, "No effect, as in the original."),
    REWARD_COIN,
];

const ENDLESS_SEARING_SPOTLIGHTS: &[Parameter] = &[
    max_steps(-1),
    Parameter::int(
        "steps_per_coin",
        160,
        i64::MIN,
        i64::MAX,
        "Maximum number of steps to collect a coin; unlimited if less than 1.",
    ),
    initial_spawns(3),
    Parameter::int("spawn_interval", 50, 0, 1_000_000_000, "Steps between two new spotlights."),
    SPOT_MIN_RADIUS,
    SPOT_MAX_RADIUS,
    SPOT_MIN_SPEED,
    SPOT_MAX_SPEED,
    SPOT_DAMAGE,
    VISUAL_FEEDBACK,
    BLACK_BACKGROUND,
    HIDE_CHESSBOARD,
    LIGHT_DIM_OFF_DURATION,
    LIGHT_THRESHOLD,
    Parameter::bool(
        "coin_enabled",
        true,
        "Whether there is a coin to collect. Without a coin, the background is black, as in the original.",
    ),
    COIN_SCALE,
    Parameter::int("coin_show_duration", 6, i64::MIN, i64::MAX, "Steps that a new coin is visible in the dark."),
    COINS_VISIBLE,
    AGENT_SPEED,
    agent_health(10.0),
    AGENT_SCALE,
    AGENT_VISIBLE,
    SAMPLE_AGENT_POSITION,
    SHOW_LAST_ACTION,
    SHOW_LAST_POSITIVE_REWARD,
    REWARD_INSIDE_SPOTLIGHT,
    REWARD_OUTSIDE_SPOTLIGHT,
    REWARD_DEATH,
    REWARD_COIN,
];

const AGENT_HEALTH_LEFT: InfoColumn =
    float("agent_health", "share of the health points left; 0 or less if the agent died");

const FINITE_INFO: &[InfoColumn] = &[
    AGENT_HEALTH_LEFT,
    float("coins_collected", "share of the coins that were collected, 0 to 1; NaN if the episode had no coins"),
    integer("success", "1 if the agent collected all coins and, if there is one, left by the exit"),
    InfoColumn {
        description: "share of the coins that were collected; with an exit, half of it plus half for leaving. 0 to 1",
        ..InfoColumn::TASK_PROGRESS
    },
];

const ENDLESS_INFO: &[InfoColumn] = &[AGENT_HEALTH_LEFT, integer("coins_collected", "coins collected in the episode")];

const GROUND_TRUTH: &[Column] = &[
    column("agent_x", "x of the agent's centre, as a share of the screen's width"),
    column("agent_y", "y of the agent's centre, as a share of the screen's height"),
    column("coin_x", "x of the coin's centre, as a share of the screen's width; 0 without a coin"),
    column("coin_y", "y of the coin's centre, as a share of the screen's height; 0 without a coin"),
];

/// The two ids of the family.
pub static IDS: LazyLock<[(EnvSpec, Variant); 2]> = LazyLock::new(|| {
    let summary = "Collect coins and leave by the exit in the dark, without being hit by moving spotlights";
    let finite = spec("SearingSpotlights-v0", summary, MOVE);
    let summary = "Collect one coin after the other in the dark, without being hit by moving spotlights";
    let endless = spec("Endless-SearingSpotlights-v0", summary, MOVE);
    let (features, keeps_state, ground_truth) = (features::columns(), true, GROUND_TRUTH);
    let (info, parameters, metric) = (FINITE_INFO, SEARING_SPOTLIGHTS, Metric::TASK_PROGRESS);
    let types = OriginalTypes { numpy_floats: &["coins_collected"], ..OriginalTypes::DEFAULT };
    let finite = EnvSpec { info, types, features, keeps_state, parameters, metric, ..finite };
    let (info, parameters) = (ENDLESS_INFO, ENDLESS_SEARING_SPOTLIGHTS);
    let metric = Metric { name: "coins_collected", label: "Coins" };
    let endless = EnvSpec { ground_truth, info, features, keeps_state, parameters, metric, learnt: None, ..endless };
    [(finite, Variant { endless: false }), (endless, Variant { endless: true })]
});
