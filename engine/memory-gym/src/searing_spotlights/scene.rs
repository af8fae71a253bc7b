//! The scene of a Searing Spotlights frame.

use smallvec::SmallVec;

use super::circles::Circles;
use super::config::{Config, HEALTH_WIDTH};
use super::state::{Background, Exit, State};
use crate::character::Character;

/// What a frame shows. The circles and coins of most frames fit without an allocation.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    pub(super) background: Background,
    /// Darkness outside the circles, 0 to 255.
    pub(super) darkness: u8,
    /// Whether only the bar and what is visible in the dark is shown.
    pub(super) blacked_out: bool,
    /// Whether the circles have outlines.
    pub(super) outlined: bool,
    /// Whether coins are visible in the dark.
    pub(super) coins_visible: bool,
    /// The lit circles on the screen; empty if there is no darkness.
    pub(super) circles: Circles,
    pub(super) coins: SmallVec<[(i32, i32); 2]>,
    pub(super) exit: Option<Exit>,
    pub(super) agent: Character,
    pub(super) bar: Bar,
}

/// What the bar at the top of the screen shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Bar {
    /// Number of red columns; more than [`HEALTH_WIDTH`] for negative health.
    pub damage: u8,
    /// Whether the red columns beyond [`HEALTH_WIDTH`] cover the fields of the action.
    pub overflows: bool,
    /// One number for each branch of the action; `None` if the action is not shown.
    pub action: Option<[u8; 2]>,
    /// Whether the reward was positive; `None` if that is not shown.
    pub reward: Option<bool>,
}

impl Bar {
    #[inline]
    fn new(state: &State, config: &Config) -> Self {
        let parameters = &config.parameters;
        let shows_reward = parameters.show_last_positive_reward && !state.first_frame;
        Bar {
            damage: state.red_columns,
            overflows: state.hit && usize::from(state.red_columns) > HEALTH_WIDTH,
            action: parameters.show_last_action.then(|| state.shown_action.map(|branch| branch as u8)),
            reward: shows_reward.then_some(state.shown_reward_positive),
        }
    }
}

impl Scene {
    /// The scene of a state.
    pub(super) fn new(state: &State, config: &Config) -> Scene {
        // Without a coin, the original paints the empty black surface of the coin over the screen.
        let blank = config.variant.endless && state.coins.is_empty();
        let coins_visible = state.coins_visible(&config.parameters);
        let blacked_out = blank && coins_visible;
        Scene {
            background: if blank { Background::Black } else { state.background },
            coins_visible,
            blacked_out,
            circles: if blacked_out { Circles::default() } else { state.shown_circles() },
            agent: state.shown_agent(),
            ..Scene::without_circles(state, config)
        }
    }

    /// The scene of a state's ground-truth view.
    pub(super) fn ground_truth(state: &State, config: &Config) -> Scene {
        Scene {
            circles: state.shown_circles(),
            agent: state.ground_truth_agent(),
            ..Scene::without_circles(state, config)
        }
    }

    #[inline]
    fn without_circles(state: &State, config: &Config) -> Scene {
        Scene {
            background: state.background,
            darkness: state.darkness,
            blacked_out: false,
            outlined: state.darkness > 0 && state.outlined,
            coins_visible: false,
            circles: Circles::default(),
            coins: SmallVec::from_slice(&state.coins),
            exit: state.exit,
            agent: Character::default(),
            bar: Bar::new(state, config),
        }
    }
}

impl State {
    /// The lit circles on the screen; none if there is no darkness.
    fn shown_circles(&self) -> Circles {
        let mut circles = Circles::default();
        if self.darkness > 0 {
            for circle in self.lit.iter().filter(|circle| circle.is_on_screen()) {
                circles.push(circle);
            }
        }
        circles
    }

    /// The agent as the frame shows it: facing up in an episode's first frame.
    pub(super) fn shown_agent(&self) -> Character {
        if self.first_frame { Character { rotation: 0, ..self.agent } } else { self.agent }
    }

    /// The agent as the ground-truth view shows it. As in the original, it is the last episode's agent until the first step,
    /// but at the current scale.
    fn ground_truth_agent(&self) -> Character {
        match self.former_agent {
            Some(former) if self.first_frame => former,
            _ => self.shown_agent(),
        }
    }
}
