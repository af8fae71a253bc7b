//! A scripted player that finds the path by trial and error, and remembers every result.

use std::collections::VecDeque;

use super::belief::Belief;
use super::config::TILE;
use super::features::{AGENT, FALLEN, HEADING};
use super::parameters::Variant;
use super::path::{GRID, Tile};
use super::route::SEGMENT;
use crate::controls::turn_or_walk;
use crate::screen::SCREEN;
use endless_gym_core::envs::Expert;

/// Pixels that the endless agent moves in a step. The screen scrolls with the agent, so the frames do not show it.
const ENDLESS_SPEED: i32 = 3;

/// Penalty for each tile of distance, as a probability.
const WALK: f64 = 0.01;

/// Prior probability that an unknown tile is on the path: next to the last tile found, and elsewhere.
const TIP: f64 = 0.5;
const ELSEWHERE: f64 = 0.03;

/// What is known about a tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Known {
    OnPath,
    OffPath,
}

/// Plays all ids of Mystery Path from the feature observation. It walks to the tile that is most likely on the path. When it
/// falls off, it remembers the tile, walks back and tries the next best. In the endless id it avoids tiles before the farthest
/// column, since a fall there ends the episode.
///
/// It needs `visual_feedback`, the default `agent_scale`, and an `agent_speed` of less than a tile; in the endless id it needs
/// the default speed, since it counts its steps to know its position. It needs no ground truth: only a fall before the farthest
/// column ends an endless episode, so it can try every tile at the end of the known path once. It cannot pass the rare paths
/// that lead back to the left.
#[derive(Debug)]
pub struct PathExpert {
    variant: Variant,
    /// What is known about each column, by row.
    columns: Vec<[Option<Known>; GRID as usize]>,
    /// The belief about each segment that the agent has entered.
    beliefs: Vec<Belief>,
    /// Horizontal centre of the endless agent in pixels of the path's coordinates.
    endless_x: i32,
    fallen: bool,
    /// The tiles to walk along, starting with the next one.
    plan: VecDeque<Tile>,
    farthest: i32,
    /// The last tile of the path that was found.
    tip: Tile,
}

impl PathExpert {
    /// An expert for one id of the family.
    pub fn new(variant: Variant) -> Self {
        PathExpert {
            variant,
            columns: Vec::new(),
            beliefs: Vec::new(),
            endless_x: TILE / 2,
            fallen: false,
            plan: VecDeque::new(),
            farthest: 0,
            tip: (0, 0),
        }
    }

    fn known(&self, (x, y): Tile) -> Option<Known> {
        *self.columns.get(usize::try_from(x).ok()?)?.get(usize::try_from(y).ok()?)?
    }

    /// Remembers whether a tile is on the path. Returns whether that was unknown.
    fn learn(&mut self, (x, y): Tile, known: Known) -> bool {
        let (Ok(column), Ok(row)) = (usize::try_from(x), usize::try_from(y)) else { return false };
        if self.variant != Variant::Endless && x >= GRID {
            return false;
        }
        if column >= self.columns.len() {
            self.columns.resize(column + 1, [None; GRID as usize]);
        }
        let Some(place) = self.columns[column].get_mut(row).filter(|place| place.is_none()) else { return false };
        *place = Some(known);
        let segment = column / SEGMENT as usize;
        if segment == self.beliefs.len() && known == Known::OnPath {
            self.beliefs.push(Belief::new(self.variant, (x % SEGMENT, y)));
        }
        if let Some(belief) = self.beliefs.get_mut(segment) {
            belief.observe((x % SEGMENT, y), known == Known::OnPath);
        }
        true
    }

    /// The tiles that the agent can walk to from a tile.
    fn reachable(&self, (x, y): Tile) -> impl Iterator<Item = Tile> + use<> {
        let endless = self.variant == Variant::Endless;
        [(x + 1, y), (x, y - 1), (x, y + 1), (x - 1, y)].into_iter().filter(move |next| {
            (0..GRID).contains(&next.1) && if endless { next.0 >= x } else { (0..GRID).contains(&next.0) }
        })
    }

    /// The probability that an unknown tile `(x, y)` next to `tile` is on the path.
    fn probability(&self, (x, y): Tile, tile: Tile) -> f64 {
        // The tile after the last tile of a segment is always on the path.
        let Some(belief) = self.beliefs.get((x / SEGMENT) as usize) else { return 1.0 };
        let (tip_x, tip_y) = self.tip;
        let prior = match () {
            // The path most likely continues next to the last tile found.
            _ if tile == self.tip => TIP,
            // If the path has no other continuation, it leads left, where the endless agent cannot go. There may be a detour.
            _ if (x, y) == (tip_x - 1, tip_y) && self.reachable(self.tip).all(|next| self.known(next).is_some()) => 1.0,
            _ => ELSEWHERE,
        };
        belief.probability((x % SEGMENT, y), prior)
    }

    /// Chooses the unknown tile to try next, and plans the shortest walk there along known tiles.
    fn make_plan(&mut self, from: Tile) {
        let mut queue = VecDeque::from([(from, 0, usize::MAX)]);
        let mut visited: Vec<(Tile, usize)> = Vec::new();
        let mut best: Option<(f64, Tile, usize)> = None;
        let mut seen = vec![[false; GRID as usize]; self.columns.len()];
        while let Some((tile, distance, before)) = queue.pop_front() {
            let place = visited.len();
            visited.push((tile, before));
            for next in self.reachable(tile) {
                match self.known(next) {
                    Some(Known::OffPath) => {}
                    Some(Known::OnPath) => {
                        let seen = &mut seen[next.0 as usize][next.1 as usize];
                        if !*seen {
                            *seen = true;
                            queue.push_back((next, distance + 1, place));
                        }
                    }
                    None => {
                        let mut score = self.probability(next, tile) - WALK * f64::from(distance);
                        if self.variant == Variant::Endless && next.0 < self.farthest {
                            score -= 2.0;
                        }
                        if best.is_none_or(|(highest, ..)| score > highest) {
                            best = Some((score, next, place));
                        }
                    }
                }
            }
        }
        self.plan.clear();
        let Some((_, target, mut place)) = best else { return };
        self.plan.push_front(target);
        while let Some(&(tile, before)) = visited.get(place).filter(|_| place != 0) {
            self.plan.push_front(tile);
            place = before;
        }
    }
}

impl Expert for PathExpert {
    fn reset(&mut self) {
        *self = PathExpert::new(self.variant);
    }

    fn act(&mut self, features: &[f32], _vector_observation: &[f32], action: &mut [i32]) {
        action.fill(0);
        let [x, y] = [AGENT, AGENT + 1].map(|place| (features[place] * SCREEN as f32).round() as i32);
        let endless = self.variant == Variant::Endless;
        if endless && self.fallen {
            self.endless_x = TILE / 2;
        }
        let x = if endless { self.endless_x } else { x };
        let tile = (x.div_euclid(TILE), y.div_euclid(TILE));
        let came_back = std::mem::replace(&mut self.fallen, features[FALLEN] == 1.0);
        if self.fallen {
            self.learn(tile, Known::OffPath);
            return;
        }
        let is_new = self.learn(tile, Known::OnPath);
        if is_new {
            self.tip = tile;
        }
        self.farthest = self.farthest.max(tile.0);
        if self.plan.front() == Some(&tile) {
            self.plan.pop_front();
        }
        if is_new || came_back || self.plan.is_empty() {
            self.make_plan(tile);
        }
        let Some(next) = self.plan.front() else { return };
        let offset = (next.0 - tile.0, next.1 - tile.1);
        let towards = |offset: i32| [1, 0, 2][(offset.signum() + 1) as usize];
        match self.variant {
            Variant::Free => {
                action[0] = towards(offset.0);
                action[1] = if offset.0 == 0 { towards(offset.1) } else { 0 };
            }
            Variant::Grid => action[0] = turn_or_walk([features[HEADING], features[HEADING + 1]], offset),
            Variant::Endless if offset.0 > 0 => {
                action[0] = 1;
                self.endless_x += ENDLESS_SPEED;
            }
            Variant::Endless => action[0] = if offset.1 < 0 { 2 } else { 3 },
        }
    }
}
