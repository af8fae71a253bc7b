//! The feature observation of Searing Spotlights: the content of a frame as numbers.

use super::config::{Config, HEALTH_WIDTH};
use super::state::{Background, Exit, State};
use crate::controls::column;
use crate::screen::SCREEN;
use endless_gym_core::envs::Column;

/// Maximum number of coins and spotlights in the features. A frame may show more.
pub(super) const COINS: usize = 8;
pub(super) const SPOTLIGHTS: usize = 16;

/// Indices of the columns in [`columns`].
pub(super) const AGENT: usize = 0;
pub(super) const HEALTH: usize = 5;
pub(super) const HIT: usize = 6;
pub(super) const LAST_ACTION: usize = 7;
pub(super) const LAST_REWARD: usize = 9;
pub(super) const LIGHT: usize = 10;
pub(super) const EXIT: usize = 11;
pub(super) const COIN: usize = 15;
pub(super) const SPOTLIGHT: usize = COIN + 3 * COINS;

const FIRST: [Column; COIN] = [
    column("agent_seen", "1 if the agent's centre is seen"),
    column("agent_x", "x of its centre as a share of the screen's width; 0 if not seen"),
    column("agent_y", "y of its centre as a share of the screen's height; 0 if not seen"),
    column("heading_x", "x of its heading, a unit vector; 0 if not seen"),
    column("heading_y", "y of its heading, a unit vector; 0 if not seen"),
    column("health", "green share of the health bar"),
    column("hit", "1 if red tiles are seen"),
    column("last_action_x", "the previous action as the bar shows it: -1 left, 1 right"),
    column("last_action_y", "the previous action as the bar shows it: -1 up, 1 down"),
    column("last_reward_positive", "1 if the bar shows that the previous step gave a positive reward"),
    column("light", "brightness outside the lit circles: 1 at first, 0 in the dark"),
    column("exit_seen", "1 if the exit's centre is seen"),
    column("exit_x", "x of its centre as a share of the screen's width; 0 if not seen"),
    column("exit_y", "y of its centre as a share of the screen's height; 0 if not seen"),
    column("exit_open", "1 if the exit is seen and open"),
];

/// Names and descriptions of the columns of one object.
type Parts = [(&'static str, &'static str); 3];

const COIN_PARTS: Parts = [
    ("seen", "1 if this coin's centre is seen; only coins that are seen are numbered"),
    ("x", "x of its centre, as a share of the width"),
    ("y", "y of its centre, as a share of the height"),
];

const SPOTLIGHT_PARTS: Parts = [
    ("radius", "radius of a lit circle that overlaps the screen, as a share of the width; 0 for none"),
    ("x", "x of its centre, as a share of the width; may lie off the screen"),
    ("y", "y of its centre, as a share of the height; may lie off the screen"),
];

/// The columns. An object counts as seen if its centre is on the screen and either not in the dark or within a lit circle.
pub fn columns() -> &'static [Column] {
    let numbered = |kind: &'static str, count, parts: Parts| {
        let columns = move |number| {
            parts.map(|(part, description)| column(format!("{kind}_{number}_{part}").leak(), description))
        };
        (0..count).flat_map(columns)
    };
    let coins = numbered("coin", COINS, COIN_PARTS);
    let spotlights = numbered("spotlight", SPOTLIGHTS, SPOTLIGHT_PARTS);
    FIRST.into_iter().chain(coins).chain(spotlights).collect::<Vec<_>>().leak()
}

impl State {
    /// Writes the feature observation.
    pub(super) fn write_features(&self, config: &Config, out: &mut [f32]) {
        out.fill(0.0);
        let parameters = &config.parameters;
        let coins_visible = self.coins_visible(parameters);
        // In the endless id without a coin, the coin's surface hides everything that is not visible in the dark.
        let blacked_out = config.variant.endless && self.coins.is_empty() && coins_visible;
        let share = |(x, y): (i32, i32)| [x as f32 / SCREEN as f32, y as f32 / SCREEN as f32];

        let agent = self.shown_agent();
        if self.is_seen(agent.position, parameters.agent_visible, blacked_out) {
            out[AGENT] = 1.0;
            out[AGENT + 1..AGENT + 3].copy_from_slice(&share(agent.position));
            out[AGENT + 3..AGENT + 5].copy_from_slice(&agent.heading());
        }
        out[HEALTH] = 1.0 - f32::from(self.red_columns.min(HEALTH_WIDTH as u8)) / HEALTH_WIDTH as f32;
        if parameters.show_last_action {
            let direction = |branch: i32| [0.0, -1.0, 1.0][branch as usize];
            out[LAST_ACTION..LAST_ACTION + 2].copy_from_slice(&self.shown_action.map(direction));
        }
        let shows_reward = parameters.show_last_positive_reward && self.shown_reward_positive;
        out[LAST_REWARD] = f32::from(u8::from(shows_reward));
        if let Some(Exit { location, open }) = self.exit
            && self.is_seen(location, parameters.exit_visible, blacked_out)
        {
            out[EXIT] = 1.0;
            out[EXIT + 1..EXIT + 3].copy_from_slice(&share(location));
            out[EXIT + 3] = f32::from(u8::from(open));
        }
        let seen_coins = self.coins.iter().filter(|coin| self.is_seen(**coin, coins_visible, blacked_out));
        for (coin, out) in seen_coins.zip(out[COIN..SPOTLIGHT].chunks_exact_mut(3)) {
            let [x, y] = share(*coin);
            out.copy_from_slice(&[1.0, x, y]);
        }
        if blacked_out {
            return;
        }
        out[LIGHT] = 1.0 - f32::from(self.darkness) / 255.0;
        let mut lit = 0;
        if self.darkness > 0 {
            let circles = self.lit.iter().filter(|circle| circle.is_on_screen());
            for (circle, out) in circles.zip(out[SPOTLIGHT..].chunks_exact_mut(3)) {
                let [x, y] = share(circle.centre());
                out.copy_from_slice(&[f32::from(circle.radius) / SCREEN as f32, x, y]);
                lit += 1;
            }
        }
        let red = self.background == Background::Red && (lit > 0 || self.darkness < 255);
        out[HIT] = f32::from(u8::from(red));
    }

    /// Whether the frame shows the centre of an object at `place`, which may be visible in the dark.
    fn is_seen(&self, place: (i32, i32), visible_in_dark: bool, blacked_out: bool) -> bool {
        let on_screen = |coordinate: i32| (0..SCREEN as i32).contains(&coordinate);
        let lit = || self.darkness < 255 || self.lit.iter().any(|circle| circle.contains(place));
        on_screen(place.0) && on_screen(place.1) && (visible_in_dark || (!blacked_out && lit()))
    }
}
