//! Plans paths to a goal through places that become dangerous and safe over time.
//!
//! Sets of places are bit sets, one for each row, so that one operation moves all places of a row.

use crate::screen::SCREEN;

/// A place in pixels: x, y.
pub(super) type Place = [i32; 2];

/// Planning horizon in steps.
pub(super) const HORIZON: usize = 28;

/// Minimum coordinates of the agent's centre.
const LOW: Place = [6, 10];
/// Maximum coordinates of the agent's centre.
const HIGH: Place = [78, 78];

/// The place to wait at without a goal.
pub(super) const NEUTRAL: Place = [42, 44];

/// Places within this distance of the limits are near the border.
const BORDER: i32 = 6;

/// The nine actions and their movements in pixels, starting with no movement.
const MOVES: [([i32; 2], Place); 9] = [
    ([0, 0], [0, 0]),
    ([1, 0], [-3, 0]),
    ([2, 0], [3, 0]),
    ([0, 1], [0, -3]),
    ([0, 2], [0, 3]),
    ([1, 1], [-2, -2]),
    ([1, 2], [-2, 2]),
    ([2, 1], [2, -2]),
    ([2, 2], [2, 2]),
];

/// The agent's place after an action.
pub(super) fn after(place: Place, action: [i32; 2]) -> Place {
    let pixels = MOVES.iter().find(|(candidate, _)| *candidate == action).map_or([0, 0], |(_, pixels)| *pixels);
    moved(place, pixels)
}

fn moved(place: Place, pixels: Place) -> Place {
    std::array::from_fn(|axis| (place[axis] + pixels[axis]).clamp(LOW[axis], HIGH[axis]))
}

/// A set of places, as a bit set for each row.
#[derive(Clone, Debug, PartialEq)]
struct Places([u128; SCREEN]);

/// The bits below each number, since WebAssembly is slow at shifts of 128 bits by numbers that vary.
const BELOW: [u128; 128] = {
    let mut below = [0; 128];
    let mut end = 1;
    while end < below.len() {
        below[end] = (below[end - 1] << 1) | 1;
        end += 1;
    }
    below
};

/// The bits `first..=last`, below 127.
fn bits(first: i32, last: i32) -> u128 {
    BELOW[(last + 1).clamp(0, 127) as usize] & !BELOW[first.clamp(0, 127) as usize]
}

/// The columns of the agent's centre.
const WALKABLE: u128 = BELOW[HIGH[0] as usize + 1] & !BELOW[LOW[0] as usize];

impl Places {
    const NONE: Places = Places([0; SCREEN]);

    fn only([x, y]: Place) -> Self {
        let mut places = Places::NONE;
        places.0[y.clamp(0, SCREEN as i32 - 1) as usize] = bits(x, x);
        places
    }

    fn contains(&self, [x, y]: Place) -> bool {
        (LOW[0]..=HIGH[0]).contains(&x) && self.0.get(y as usize).is_some_and(|row| row & bits(x, x) != 0)
    }

    fn is_empty(&self) -> bool {
        self.0.iter().all(|row| *row == 0)
    }

    /// The intersection of both sets.
    fn and(mut self, other: &Places) -> Self {
        self.0.iter_mut().zip(&other.0).for_each(|(row, other)| *row &= other);
        self
    }

    /// The places from which an action leads into the set.
    fn before(&self) -> Self {
        let mut before = Places::NONE;
        let [straight, level, diagonal] = self.rows(
            |row| columns_before::<-3>(row) | columns_before::<3>(row),
            |row| columns_before::<-2>(row) | columns_before::<2>(row),
        );
        for (dy, rows) in [(0, &level), (-3, &straight), (3, &straight), (-2, &diagonal), (2, &diagonal)] {
            for y in LOW[1]..=HIGH[1] {
                before.0[y as usize] |= rows[(y + dy).clamp(LOW[1], HIGH[1]) as usize];
            }
        }
        before
    }

    /// The places to which an action leads from the set.
    fn after(&self) -> Self {
        let mut after = Places::NONE;
        let [straight, level, diagonal] = self.rows(
            |row| columns_after::<-3>(row) | columns_after::<3>(row),
            |row| columns_after::<-2>(row) | columns_after::<2>(row),
        );
        for (dy, rows) in [(0, &level), (-3, &straight), (3, &straight), (-2, &diagonal), (2, &diagonal)] {
            for y in LOW[1]..=HIGH[1] {
                after.0[(y + dy).clamp(LOW[1], HIGH[1]) as usize] |= rows[y as usize];
            }
        }
        after
    }

    /// The columns of each row after the [`MOVES`] that go straight up or down, stay in the row, or are diagonal.
    fn rows(&self, aside: impl Fn(u128) -> u128, diagonal: impl Fn(u128) -> u128) -> [[u128; SCREEN]; 3] {
        let straight = self.0.map(|row| row & WALKABLE);
        [straight, straight.map(|row| row | aside(row)), straight.map(diagonal)]
    }

    fn iter(&self) -> impl Iterator<Item = Place> + '_ {
        (LOW[1]..=HIGH[1]).flat_map(move |y| {
            let row = self.0[y as usize];
            (LOW[0]..=HIGH[0]).filter(move |x| row & bits(*x, *x) != 0).map(move |x| [x, y])
        })
    }
}

/// The columns from which a move of `DX`, clamped to the limits, leads into `row`, whose columns are walkable.
fn columns_before<const DX: i32>(row: u128) -> u128 {
    let shifted = if DX >= 0 { row >> DX } else { row << -DX };
    let (edge, held) =
        if DX >= 0 { (HIGH[0], bits(HIGH[0] - DX, HIGH[0])) } else { (LOW[0], bits(LOW[0], LOW[0] - DX)) };
    let held = if row & bits(edge, edge) != 0 { held } else { 0 };
    (shifted | held) & WALKABLE
}

/// The columns to which a move of `DX`, clamped to the limits, leads from `row`, whose columns are walkable.
fn columns_after<const DX: i32>(row: u128) -> u128 {
    let shifted = if DX >= 0 { row << DX } else { row >> -DX };
    let held = match shifted & !WALKABLE {
        0 => 0,
        _ if DX > 0 => bits(HIGH[0], HIGH[0]),
        _ => bits(LOW[0], LOW[0]),
    };
    (shifted & WALKABLE) | held
}

/// The places where the agent is hit in a step.
#[derive(Clone, Debug)]
pub(super) struct Danger(Places);

impl Danger {
    pub fn none() -> Self {
        Danger(Places::NONE)
    }

    /// Adds all places within `reach` pixels of `centre`.
    pub fn add(&mut self, centre: [f64; 2], reach: f64) {
        let [first, end] = [centre[1] - reach, centre[1] + reach + 2.0].map(|y| (y.max(0.0) as usize).min(SCREEN));
        for (y, row) in self.0.0.iter_mut().enumerate().take(end).skip(first) {
            let rest = reach * reach - (y as f64 - centre[1]).powi(2);
            if rest >= 0.0 {
                let half = rest.sqrt();
                *row |= bits((centre[0] - half).ceil() as i32, (centre[0] + half).floor() as i32);
            }
        }
    }

    /// Adds the places near the border.
    pub fn add_border(&mut self) {
        for (y, row) in (0..).zip(&mut self.0.0) {
            let inside = y >= LOW[1] + BORDER / 3 && y <= HIGH[1] - BORDER;
            *row |= if inside { !bits(LOW[0] + BORDER, HIGH[0] - BORDER) } else { u128::MAX };
        }
    }

    fn safe(&self) -> Places {
        Places(self.0.0.map(|row| !row))
    }
}

/// The goal: any place within `reach` pixels of `place`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Goal {
    pub place: Place,
    pub reach: i32,
}

impl Goal {
    fn distance(&self, place: Place) -> i32 {
        (0..2).map(|axis| (place[axis] - self.place[axis]).pow(2)).sum()
    }

    fn places(&self) -> Places {
        let mut danger = Danger::none();
        danger.add(self.place.map(f64::from), f64::from(self.reach));
        danger.0
    }
}

/// The next action, and the outcome of the rest of the plan.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plan {
    pub action: [i32; 2],
    /// Number of dangerous steps.
    pub hits: usize,
    /// Whether the plan reaches the goal before the horizon.
    pub arrives: bool,
}

/// The first action of the path with the fewest dangerous steps up to the horizon and, among those, the earliest arrival at the
/// goal or the smallest distance to it. `dangers` has an entry for the current step, which is ignored, and one for each future
/// step.
pub(super) fn choose(start: Place, goal: Goal, dangers: &[Danger]) -> Plan {
    let start = moved(start, [0, 0]);
    let next = MOVES.map(|(action, pixels)| (action, moved(start, pixels)));
    let safe = survivable(dangers, None);
    if next.iter().any(|(_, place)| safe[1].contains(*place)) {
        let (action, arrives) = safe_action(start, goal, &safe);
        return Plan { action, hits: 0, arrives };
    }
    // With as many hits as steps, every path is possible.
    let mut allowed = safe;
    for hits in 1..dangers.len() {
        allowed = survivable(dangers, Some(&allowed));
        let firsts = next.iter().filter(|(_, place)| allowed[1].contains(*place));
        if let Some((action, _)) = firsts.min_by_key(|(_, place)| goal.distance(*place)) {
            return Plan { action: *action, hits, arrives: false };
        }
    }
    Plan { action: [0, 0], hits: dangers.len(), arrives: false }
}

/// For each step, the places from which the rest of the path needs no dangerous step, or one more than from the places of
/// `easier`.
fn survivable(dangers: &[Danger], easier: Option<&[Places]>) -> Vec<Places> {
    let everywhere = Places([u128::MAX; SCREEN]);
    let mut sets = vec![everywhere.clone(); dangers.len() + 1];
    for step in (1..dangers.len()).rev() {
        let before = |sets: &[Places]| {
            let is_last = step + 1 == dangers.len();
            if is_last { everywhere.clone() } else { sets[step + 1].before() }
        };
        let mut set = before(&sets).and(&dangers[step].safe());
        if let Some(easier) = easier {
            let hurt = before(easier).and(&dangers[step].0);
            set.0.iter_mut().zip(&hurt.0).for_each(|(row, hurt)| *row |= hurt);
        }
        sets[step] = set;
    }
    sets
}

/// The first action of the path to the goal with the fewest dangerous steps, if one exists with at most `max_hits` of them.
/// Ignores what happens after the arrival.
pub(super) fn dash(start: Place, goal: Goal, dangers: &[Danger], max_hits: usize) -> Option<Plan> {
    let safe: Vec<Places> = dangers.iter().map(Danger::safe).collect();
    let (action, hits) = shortest_path(moved(start, [0, 0]), goal, &safe, max_hits)?;
    Some(Plan { action, hits, arrives: true })
}

/// The first action of the path to the goal through `safe` places, one set for each step, and whether it arrives.
fn safe_action(start: Place, goal: Goal, safe: &[Places]) -> ([i32; 2], bool) {
    shortest_path(start, goal, safe, 0)
        .map_or_else(|| (approach(start, goal, safe), false), |(action, _)| (action, true))
}

/// The first action and the number of dangerous steps of the shortest path to the goal among those with the fewest dangerous
/// steps.
fn shortest_path(start: Place, goal: Goal, safe: &[Places], max_hits: usize) -> Option<([i32; 2], usize)> {
    let goals = goal.places();
    // For each number of dangerous steps, the places after each step.
    let mut easier: Vec<Places> = Vec::new();
    let mut reached: Vec<Vec<Places>> = Vec::new();
    for hits in 0..=max_hits {
        let mut places = vec![if hits == 0 { Places::only(start) } else { Places::NONE }];
        for (step, safe) in safe.iter().enumerate().take(HORIZON + 1).skip(1) {
            let mut next = places[step - 1].after().and(safe);
            if let Some(easier) = easier.get(step - 1) {
                let hurt = easier.after().0;
                next.0.iter_mut().zip(hurt.iter().zip(&safe.0)).for_each(|(next, (hurt, safe))| *next |= hurt & !safe);
            }
            places.push(next);
        }
        let arrival = places.iter().map(|places| places.clone().and(&goals)).enumerate().skip(1);
        let arrival = arrival.filter(|(_, places)| !places.is_empty()).find_map(|(step, places)| {
            places.iter().min_by_key(|place| goal.distance(*place)).map(|place| (step, place))
        });
        easier = places.clone();
        reached.push(places);
        if let Some((step, place)) = arrival {
            return first_action(step, place, hits, &reached, safe).map(|action| (action, hits));
        }
    }
    None
}

/// The first action of the path that ends nearest to the goal.
fn approach(start: Place, goal: Goal, safe: &[Places]) -> [i32; 2] {
    let mut reached = vec![Places::only(start)];
    for (step, safe) in safe.iter().enumerate().take(HORIZON + 1).skip(1) {
        reached.push(reached[step - 1].after().and(safe));
    }
    let last = reached.len() - 1;
    let nearest = reached[last].iter().min_by_key(|place| goal.distance(*place));
    nearest.and_then(|place| first_action(last, place, 0, &[reached], safe)).unwrap_or([0, 0])
}

/// Traces a path back from its place after `step` steps with `hits` hits, and returns its first action.
fn first_action(
    mut step: usize,
    mut place: Place,
    mut hits: usize,
    reached: &[Vec<Places>],
    safe: &[Places],
) -> Option<[i32; 2]> {
    loop {
        hits -= usize::from(!safe[step].contains(place));
        let before = reached.get(hits)?.get(step - 1)?;
        let near = (-3..=3).flat_map(|x| (-3..=3).map(move |y| [place[0] + x, place[1] + y]));
        let (from, action) = near.filter(|from| before.contains(*from)).find_map(|from| {
            let found = MOVES.iter().find(|(_, pixels)| moved(from, *pixels) == place)?;
            Some((from, found.0))
        })?;
        if step == 1 {
            return Some(action);
        }
        step -= 1;
        place = from;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moves_of_sets_are_the_moves_of_their_places() {
        let corners = [[6, 10], [7, 11], [78, 78], [77, 40], [40, 79], [42, 42]];
        for start in corners.map(|place| moved(place, [0, 0])) {
            let after = Places::only(start).after();
            let expected = MOVES.map(|(_, pixels)| moved(start, pixels));
            assert!(after.iter().all(|place| expected.contains(&place)), "{start:?}");
            for place in expected {
                assert!(after.contains(place), "{start:?} to {place:?}");
                assert!(Places::only(place).before().contains(start), "{start:?} to {place:?}");
            }
        }
    }

    #[test]
    fn walks_straight_without_danger() {
        let dangers = vec![Danger::none(); HORIZON + 1];
        let goal = Goal { place: [70, 40], reach: 3 };
        let mut place = [20, 40];
        for _ in 0..16 {
            place = after(place, choose(place, goal, &dangers).action);
        }
        assert!(goal.distance(place) <= 9, "{place:?}");
    }

    #[test]
    fn waits_for_a_wall_of_light_to_pass() {
        let wall = |step: usize| {
            let mut danger = Danger::none();
            if step < 12 {
                (0..84).step_by(4).for_each(|y| danger.add([40.0, f64::from(y)], 6.0));
            }
            danger
        };
        let dangers: Vec<_> = (0..=HORIZON).map(wall).collect();
        let goal = Goal { place: [60, 40], reach: 3 };
        let plan = choose([30, 40], goal, &dangers);
        assert_eq!(plan.hits, 0);
        let surrounded = vec![Danger(Places([u128::MAX; SCREEN])); HORIZON + 1];
        assert_eq!(choose([30, 40], goal, &surrounded).hits, HORIZON);
    }
}
