//! A scripted player that tracks its own position, remembers coins and exit, and plans around the forecast spotlights.

mod forecast;
mod plan;

use super::features::{AGENT, COIN, EXIT, HEALTH, SPOTLIGHT};
use super::parameters::Variant;
use crate::screen::SCREEN;
use endless_gym_core::envs::Expert;
use forecast::Forecast;
use plan::{Danger, Goal, HORIZON, NEUTRAL, Place, after, dash, least_harmed, unharmed, within};

/// Distances in pixels between the centres of agent and coin or exit at which the agent reaches them, minus a safety margin.
const COIN_REACH: i32 = 9;
const EXIT_REACH: i32 = 11;

/// Initial number of steps to reach a target.
const PATIENCE: u32 = 150;
/// With more steps left than this, the expert only follows its most cautious plan.
const CALM: u32 = 130;
/// With fewer steps left than this, the expert accepts hits, but keeps one health point.
const URGENT: u32 = 90;
/// Steps below [`URGENT`] for each accepted hit.
const STEPS_PER_HIT: u32 = 10;

/// Default health points at the start of an episode.
const FINITE_HEALTH: f32 = 5.0;
const ENDLESS_HEALTH: f32 = 10.0;

/// Maximum margin in pixels around a forecast spotlight.
const MAX_MARGIN: f64 = 6.0;

/// Share of the margin in the search for the path with the fewest hits.
const HURRY: f64 = 0.1;
/// Share of the margin in the search for a path out of the light.
const ESCAPE: f64 = 0.2;

/// Shares of the margin for the forecasts' uncertainty, and whether to avoid the border; most cautious first.
const CAUTIONS: [(f64, bool); 6] = [(1.0, true), (0.5, true), (1.0, false), (0.5, false), (0.2, false), (0.0, false)];

/// Radius of the agent in pixels.
const AGENT_RADIUS: f64 = 6.0;

/// Plays Searing Spotlights from the feature observation. It assumes the default movement and sizes, so it needs the default
/// `agent_speed`, `agent_scale`, `coin_scale` and `exit_scale`, and a lit first frame.
///
/// It wins almost every episode of the finite id. In the endless id most episodes last more than 10,000 steps. The others end
/// because slow spotlights cover the surroundings of a coin for most of its 160 steps, so that the agent is too late or loses
/// its health.
#[derive(Debug)]
pub struct SpotlightsExpert {
    variant: Variant,
    /// The agent's position, as seen or computed from its moves.
    agent: Option<Place>,
    coins: Vec<Place>,
    exit: Option<Place>,
    spotlights: Vec<Forecast>,
    /// Health points left.
    health: u32,
    target: Option<Place>,
    /// Steps left to reach the target. With fewer steps, the expert takes greater risks.
    patience: u32,
}

impl SpotlightsExpert {
    /// An expert for one id of the family.
    pub fn new(variant: Variant) -> Self {
        SpotlightsExpert {
            variant,
            agent: None,
            coins: Vec::new(),
            exit: None,
            spotlights: Vec::new(),
            health: 0,
            target: None,
            patience: PATIENCE,
        }
    }

    /// Updates what is known from the features.
    fn observe(&mut self, features: &[f32]) {
        let full_health = if self.variant.endless { ENDLESS_HEALTH } else { FINITE_HEALTH };
        self.health = (features[HEALTH] * full_health).round() as u32;
        let place = |at: usize| [features[at], features[at + 1]].map(|share| (share * SCREEN as f32).round() as i32);
        if features[AGENT] == 1.0 {
            self.agent = Some(place(AGENT + 1));
        }
        if features[EXIT] == 1.0 {
            self.exit = Some(place(EXIT + 1));
        }
        let agent = self.agent;
        let reached = |coin: &Place| agent.is_some_and(|agent| is_within(agent, *coin, COIN_REACH));
        let seen = features[COIN..SPOTLIGHT].chunks_exact(3).enumerate().filter(|(_, coin)| coin[0] == 1.0);
        let seen: Vec<Place> = seen.map(|(number, _)| place(COIN + 3 * number + 1)).collect();
        self.coins.retain(|coin| !reached(coin));
        for coin in seen {
            if self.variant.endless {
                self.coins.clear();
            }
            if !self.coins.contains(&coin) {
                self.coins.push(coin);
            }
        }
        self.track_spotlights(features);
    }

    /// Tracks the lit circles from frame to frame.
    fn track_spotlights(&mut self, features: &[f32]) {
        let pixels = |share: f32| (share * SCREEN as f32).round() as i32;
        let mut unmatched: Vec<(i32, Place)> = features[SPOTLIGHT..]
            .chunks_exact(3)
            .filter(|circle| circle[0] > 0.0)
            .map(|circle| (pixels(circle[0]), [pixels(circle[1]), pixels(circle[2])]))
            .collect();
        for forecast in &mut self.spotlights {
            let nearest = (0..unmatched.len())
                .filter(|&index| unmatched[index].0 == forecast.radius)
                .map(|index| (forecast.error(unmatched[index].1), index))
                .min_by(|a, b| a.0.total_cmp(&b.0));
            match nearest {
                Some((error, index)) if error < 4.0 => forecast.observe(unmatched.swap_remove(index).1),
                _ => forecast.miss(),
            }
        }
        self.spotlights.retain(Forecast::is_alive);
        self.spotlights.extend(unmatched.into_iter().map(|(radius, place)| Forecast::new(radius, place)));
    }

    /// The most cautious plan that reaches the goal; otherwise, if time is short, the plan with the fewest hits that reaches
    /// it; otherwise the most cautious plan without hits.
    fn plan(&self, agent: Place, goal: Goal) -> [i32; 2] {
        let path = |spotlight: &Forecast| (spotlight.radius, (0..=HORIZON).map(|step| spotlight.at(step)).collect());
        let forecasts: Vec<Path> = self.spotlights.iter().map(path).collect();
        let dangers = |caution, avoid_border| dangers(agent, &forecasts, caution, avoid_border);
        let mut waiting = None;
        for (caution, avoid_border) in CAUTIONS {
            if let Some(plan) = unharmed(agent, goal, &dangers(caution, avoid_border)) {
                if plan.arrives {
                    return plan.action;
                }
                waiting.get_or_insert(plan.action);
                if self.patience > CALM {
                    break;
                }
            }
        }
        let hits = (URGENT.saturating_sub(self.patience) / STEPS_PER_HIT).min(self.health.saturating_sub(1)) as usize;
        let dash = if hits > 0 { dash(agent, goal, &dangers(HURRY, false), hits) } else { None };
        dash.or(waiting).unwrap_or_else(|| least_harmed(agent, goal, &dangers(ESCAPE, false)))
    }
}

/// The radius of a spotlight, and its centre and standard deviation in each step.
type Path = (i32, Vec<([f64; 2], f64)>);

/// The dangerous positions of each future step that `agent` can reach, with this share of the margin for the forecasts' uncertainty.
fn dangers(agent: Place, forecasts: &[Path], caution: f64, avoid_border: bool) -> Vec<Danger> {
    let mut dangers = vec![Danger::none(); HORIZON + 1];
    for (step, danger) in dangers.iter_mut().enumerate().skip(1) {
        for (radius, path) in forecasts {
            let (centre, deviation) = path[step];
            let margin = (caution * (1.0 + deviation)).min(MAX_MARGIN);
            danger.add(centre, f64::from(*radius) + AGENT_RADIUS + 0.5 + margin, within(agent, step));
        }
        // Near the border, a new spotlight leaves no time to escape. The first steps are exempt, so that the agent can
        // leave the border.
        if avoid_border && step > 4 {
            danger.add_border();
        }
    }
    dangers
}

fn is_within(a: Place, b: Place, reach: i32) -> bool {
    let [x, y] = [a[0] - b[0], a[1] - b[1]];
    x * x + y * y <= reach * reach
}

impl Expert for SpotlightsExpert {
    fn reset(&mut self) {
        *self = SpotlightsExpert::new(self.variant);
    }

    fn act(&mut self, features: &[f32], _vector_observation: &[f32], action: &mut [i32]) {
        action.fill(0);
        self.observe(features);
        let Some(agent) = self.agent else { return };
        let nearest = self.coins.iter().min_by_key(|coin| {
            let [x, y] = [coin[0] - agent[0], coin[1] - agent[1]];
            x * x + y * y
        });
        let goal = match (nearest, self.exit) {
            (Some(coin), _) => Goal { place: *coin, reach: COIN_REACH },
            (None, Some(exit)) => Goal { place: exit, reach: EXIT_REACH },
            (None, None) => Goal { place: NEUTRAL, reach: 1 },
        };
        self.patience = if self.target == Some(goal.place) { self.patience.saturating_sub(1) } else { PATIENCE };
        self.target = Some(goal.place);
        let best = self.plan(agent, goal);
        action.copy_from_slice(&best);
        self.agent = Some(after(agent, best));
    }
}
