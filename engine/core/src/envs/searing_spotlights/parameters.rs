//! The ids of Searing Spotlights and their reset parameters.
//!
//! Source: `default_reset_parameters` of the original. It checks no value, so the limits are ours: wide enough for every use,
//! narrow enough that no value makes the rules meaningless, the memory large or a step slow.

use crate::envs::{ActionSpace, Family, InfoColumn, Parameter, ResetParameters, Spec};

/// What tells the ids of the family apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Variant {
    /// A collected coin gives way to a new one, and there is no exit.
    pub endless: bool,
}

/// One set of reset parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    pub max_steps: i64,
    /// Steps within which a coin has to be collected; not limited if less than 1.
    pub steps_per_coin: i64,
    pub initial_spawns: usize,
    /// Spotlights that appear later, and the steps between them.
    pub num_spawns: i64,
    pub spawn_interval: i64,
    pub spot_min_radius: f64,
    pub spot_max_radius: f64,
    pub spot_min_speed: f64,
    pub spot_max_speed: f64,
    pub spot_damage: f64,
    pub visual_feedback: bool,
    pub black_background: bool,
    pub hide_chessboard: bool,
    /// How much darker each step makes the screen, of 255; `None` for a screen that is as dark at first as it ever gets.
    pub dimming: Option<i32>,
    pub light_threshold: i32,
    pub num_coins: Vec<i64>,
    pub coin_scale: f64,
    /// Steps that a new coin is seen in the dark.
    pub coin_show_duration: i64,
    pub coins_visible: bool,
    pub use_exit: bool,
    pub exit_scale: f64,
    pub exit_visible: bool,
    pub agent_speed: f64,
    pub agent_health: f64,
    pub agent_scale: f64,
    pub agent_visible: bool,
    pub sample_agent_position: bool,
    pub show_last_action: bool,
    pub show_last_positive_reward: bool,
    pub reward_inside_spotlight: f64,
    pub reward_outside_spotlight: f64,
    pub reward_death: f64,
    pub reward_exit: f64,
    pub reward_coin: f64,
}

/// Most spotlights that an environment ever has at a time. The original has no limit; with this one a spotlight that is due
/// waits for another to leave.
pub const MAX_SPOTLIGHTS: usize = 1000;

/// Largest radius of a spotlight in pixels: more than the screen's diagonal.
pub const MAX_SPOT_RADIUS: i32 = 256;

impl Parameters {
    /// Reads the parameters of the family out of a checked set.
    pub fn new(variant: Variant, given: &ResetParameters) -> Self {
        let dim_off = given.int("light_dim_off_duration", 6);
        // The original computes a list of ever shorter intervals, but takes the first of them each time.
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

const fn max_steps(default: i64) -> Parameter {
    const ANY: (i64, i64) = (i64::MIN, i64::MAX);
    Parameter::int("max_steps", default, ANY.0, ANY.1, "Steps that an episode may last; not limited if less than 1.")
}

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
    "Least radius of a spotlight in pixels, without its fraction.",
);
const SPOT_MAX_RADIUS: Parameter = Parameter::float(
    "spot_max_radius",
    13.75,
    0.0,
    MAX_SPOT_RADIUS as f64,
    "Largest radius of a spotlight in pixels, without its fraction.",
);
const SPOT_MIN_SPEED: Parameter = Parameter::float(
    "spot_min_speed",
    0.0025,
    0.0,
    1e6,
    "Least speed of a spotlight: the share of its way that a step takes.",
);
const SPOT_MAX_SPEED: Parameter = Parameter::float("spot_max_speed", 0.0075, 0.0, 1e6, "Largest speed of a spotlight.");
const SPOT_DAMAGE: Parameter =
    Parameter::float("spot_damage", 1.0, 0.0, 1e9, "Health points that a step in the light of spotlights costs.");
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
    "Steps in which the light goes off; 0 for no light at all.",
);
const LIGHT_THRESHOLD: Parameter = Parameter::int(
    "light_threshold",
    255,
    0,
    255,
    "How dark it gets: 255 is black. With steps of dimming, darker by up to one of them.",
);
const COIN_SCALE: Parameter =
    Parameter::float("coin_scale", 0.375, 0.0, 8.0, "Size of a coin; 1 is a radius of 10 pixels.");
const COINS_VISIBLE: Parameter = Parameter::bool("coins_visible", false, "Whether coins are seen in the dark.");
const AGENT_SPEED: Parameter =
    Parameter::float("agent_speed", 3.0, 0.0, 84.0, "Speed of the agent in pixels per step.");
const AGENT_SCALE: Parameter =
    Parameter::float("agent_scale", 0.25, 0.0, 4.0, "Size of the agent; 0.25 is a radius of 6 pixels.");
const AGENT_VISIBLE: Parameter = Parameter::bool("agent_visible", false, "Whether the agent is seen in the dark.");
const SAMPLE_AGENT_POSITION: Parameter =
    Parameter::bool("sample_agent_position", true, "Whether the agent starts at a random place, or in the middle.");
const SHOW_LAST_ACTION: Parameter =
    Parameter::bool("show_last_action", true, "Whether the bar at the top shows the action before the current one.");
const SHOW_LAST_POSITIVE_REWARD: Parameter = Parameter::bool(
    "show_last_positive_reward",
    true,
    "Whether the bar at the top shows that the step before gave a positive reward.",
);
const REWARD_INSIDE_SPOTLIGHT: Parameter =
    Parameter::reward("reward_inside_spotlight", 0.0, "Reward for each step in a spotlight.");
const REWARD_OUTSIDE_SPOTLIGHT: Parameter =
    Parameter::reward("reward_outside_spotlight", 0.0, "Reward for each step outside of all spotlights.");
const REWARD_DEATH: Parameter = Parameter::reward("reward_death", 0.0, "Reward for losing all health points.");
const REWARD_COIN: Parameter = Parameter::reward("reward_coin", 0.25, "Reward for collecting a coin.");

const SEARING_SPOTLIGHTS: &[Parameter] = &[
    max_steps(256),
    initial_spawns(4),
    Parameter::int("num_spawns", 30, 0, MAX_SPOTLIGHTS as i64, "Spotlights that appear in the course of an episode."),
    Parameter::int(
        "initial_spawn_interval",
        30,
        0,
        1_000_000_000,
        "Steps between two new spotlights, beside `spawn_interval_threshold`.",
    ),
    Parameter::int("spawn_interval_threshold", 10, 0, 1_000_000_000, "Steps that are added to each interval."),
    Parameter::float(
        "spawn_interval_decay",
        0.95,
        0.0,
        1e6,
        "Without effect, as in the original, which means to shorten the interval.",
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
    Parameter::list("num_coins", &[1], 0, 100, "Number of coins. A list to draw from."),
    COIN_SCALE,
    COINS_VISIBLE,
    Parameter::bool(
        "use_exit",
        true,
        "Whether the agent has to leave by an exit that opens once all coins are collected.",
    ),
    Parameter::float("exit_scale", 0.5, 0.0, 8.0, "Size of the exit; 1 is a side of 20 pixels."),
    Parameter::bool("exit_visible", false, "Whether the exit is seen in the dark."),
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
    Parameter::reward("reward_max_steps", 0.0, "Without effect, as in the original."),
    REWARD_COIN,
];

const ENDLESS_SEARING_SPOTLIGHTS: &[Parameter] = &[
    max_steps(-1),
    Parameter::int(
        "steps_per_coin",
        160,
        i64::MIN,
        i64::MAX,
        "Steps within which a new coin has to be collected; not limited if less than 1.",
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
        "Whether there is a coin to collect. Without, the background is black, as in the original.",
    ),
    COIN_SCALE,
    Parameter::int("coin_show_duration", 6, i64::MIN, i64::MAX, "Steps that a new coin is seen in the dark."),
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

const AGENT_HEALTH_LEFT: InfoColumn = InfoColumn {
    name: "agent_health",
    is_integer: false,
    description: "share of the health points that is left; not above 0 if the agent died",
};

const FINITE_INFO: &[InfoColumn] = &[
    AGENT_HEALTH_LEFT,
    InfoColumn {
        name: "coins_collected",
        is_integer: false,
        description: "share of the coins that were collected, 0 to 1; 0 if there were none",
    },
    InfoColumn {
        name: "success",
        is_integer: true,
        description: "1 if the agent collected all coins and, if there is one, left by the exit",
    },
];

const ENDLESS_INFO: &[InfoColumn] = &[
    AGENT_HEALTH_LEFT,
    InfoColumn { name: "coins_collected", is_integer: true, description: "coins collected in the episode" },
];

/// The two ids of the family.
pub const SPECS: &[Spec] = &[
    Spec {
        id: "SearingSpotlights-v0",
        summary: "Collect coins and leave by the exit in the dark, unseen by moving spotlights",
        family: Family::SearingSpotlights(Variant { endless: false }),
        action_space: ActionSpace::multi_discrete(&[3, 3]),
        vector_observation: 0,
        ground_truth: 0,
        info: FINITE_INFO,
        features: super::features::FEATURES,
        parameters: SEARING_SPOTLIGHTS,
        render_fps: 25,
    },
    Spec {
        id: "Endless-SearingSpotlights-v0",
        summary: "Collect one coin after the other in the dark, unseen by moving spotlights",
        family: Family::SearingSpotlights(Variant { endless: true }),
        action_space: ActionSpace::multi_discrete(&[3, 3]),
        vector_observation: 0,
        ground_truth: 4,
        info: ENDLESS_INFO,
        features: super::features::FEATURES,
        parameters: ENDLESS_SEARING_SPOTLIGHTS,
        render_fps: 25,
    },
];
