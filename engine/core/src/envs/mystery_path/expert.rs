//! A scripted player that finds the path by trying, and remembers what it tried.

use std::collections::VecDeque;

use super::belief::Belief;
use super::drawing::TILE;
use super::features::{AGENT, FALLEN, HEADING};
use super::parameters::Variant;
use super::path::{GRID, Tile};
use super::route::SEGMENT;
use crate::envs::steering::turn_or_walk;
use crate::envs::{Expert, SCREEN};

/// Pixels that the endless agent moves in a step, which cannot be seen on a screen that moves with it.
const ENDLESS_SPEED: i32 = 3;

/// How much less likely a tile may be for each tile that it is nearer.
const WALK: f64 = 0.01;

/// What to think of an unknown tile where nothing else tells: beside the last tile found, and beside others.
const TIP: f64 = 0.5;
const ELSEWHERE: f64 = 0.03;

/// What is known about a tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Known {
    OnPath,
    OffPath,
}

/// Plays Mystery Path from what a frame shows, all of its ids. It walks to the tile that is most likely on the path, and when it
/// falls off it remembers where, walks back and tries the next best. In the endless id it tries nothing before the farthest
/// column if it can, for that would end the episode.
///
/// It wants `visual_feedback`, the default `agent_scale`, and an `agent_speed` of less than a tile; in the endless id the default
/// one, since it counts its steps to know how far it is. It needs no ground truth: only a fall before the farthest column ends an
/// endless episode, so that everything can be tried once at the end of the known way. What it cannot pass is the rare way that
/// leads back to the left.
#[derive(Debug)]
pub struct PathExpert {
    variant: Variant,
    /// What is known of each column of the way, by row.
    columns: Vec<[Option<Known>; GRID as usize]>,
    /// What is expected of each segment that was entered.
    beliefs: Vec<Belief>,
    /// Horizontal centre of the endless agent in pixels of the way.
    endless_x: i32,
    fallen: bool,
    /// The tiles to walk along, the next one first.
    plan: VecDeque<Tile>,
    farthest: i32,
    /// The tile of the path that was found last.
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

    /// Remembers whether a tile is on the path: whether that is news.
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
            belief.learn((x % SEGMENT, y), known == Known::OnPath);
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

    /// The chance that an unknown tile beside `tile` is on the path.
    fn chance(&self, (x, y): Tile, tile: Tile) -> f64 {
        // From the last tile of a segment the way always leads on.
        let Some(belief) = self.beliefs.get((x / SEGMENT) as usize) else { return 1.0 };
        let (tip_x, tip_y) = self.tip;
        let guess = match () {
            // The path goes on where it was last found, rather than beside some tile before.
            _ if tile == self.tip => TIP,
            // The endless agent cannot go left, where a path that ends for it must go on. There may be another way to it.
            _ if (x, y) == (tip_x - 1, tip_y) && self.reachable(self.tip).all(|next| self.known(next).is_some()) => 1.0,
            _ => ELSEWHERE,
        };
        belief.chance((x % SEGMENT, y), guess)
    }

    /// Looks for the unknown tile to try, and for the way along the known path that leads there.
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
                        let mut score = self.chance(next, tile) - WALK * f64::from(distance);
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
        let news = self.learn(tile, Known::OnPath);
        if news {
            self.tip = tile;
        }
        self.farthest = self.farthest.max(tile.0);
        if self.plan.front() == Some(&tile) {
            self.plan.pop_front();
        }
        if news || came_back || self.plan.is_empty() {
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
