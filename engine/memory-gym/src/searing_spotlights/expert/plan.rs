//! Plans paths to a goal through places that become dangerous and safe over time.
//!
//! Sets of places are bit sets, one for each row, so that one operation moves all places of a row.

use std::ops::RangeInclusive;

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

/// The columns and rows that the agent can reach from a place in that many steps.
pub(super) fn within(start: Place, steps: usize) -> [RangeInclusive<i32>; 2] {
    let (start, most) = (moved(start, [0, 0]), 3 * steps as i32);
    std::array::from_fn(|axis| (start[axis] - most).max(LOW[axis])..=(start[axis] + most).min(HIGH[axis]))
}

fn rows_within(start: Place, steps: usize) -> RangeInclusive<i32> {
    let [_, rows] = within(start, steps);
    rows
}

/// A bit set of columns for each row.
type Rows = [u128; SCREEN];

/// A set of places.
#[derive(Clone, Debug, PartialEq)]
struct Places(Rows);

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

    /// The intersection of both sets.
    fn and(mut self, other: &Places) -> Self {
        self.0.iter_mut().zip(&other.0).for_each(|(row, other)| *row &= other);
        self
    }

    /// The places that are not in the other set.
    fn without(mut self, other: &Places) -> Self {
        self.0.iter_mut().zip(&other.0).for_each(|(row, other)| *row &= !other);
        self
    }

    fn is_empty(&self) -> bool {
        self.0.iter().all(|row| *row == 0)
    }

    fn extend(&mut self, other: &Places) {
        self.0.iter_mut().zip(&other.0).for_each(|(row, other)| *row |= other);
    }

    /// The places in `rows` from which an action leads into the set.
    fn before(&self, rows: RangeInclusive<i32>) -> Self {
        let [low, high] = [LOW[1], HIGH[1]].map(|y| y as usize);
        let near = (rows.start() - 3).max(LOW[1])..=(rows.end() + 3).min(HIGH[1]);
        let [mut straight, level, mut diagonal] = self.rows(
            near,
            |row| columns_before::<-3>(row) | columns_before::<3>(row),
            |row| columns_before::<-2>(row) | columns_before::<2>(row),
        );
        // Moves beyond the limits end at them.
        for (moved, most) in [(&mut straight, 3), (&mut diagonal, 2)] {
            let [first, last] = [moved[low], moved[high]];
            moved[low - most..low].fill(first);
            moved[high + 1..=high + most].fill(last);
        }
        Places::gathered(rows, &straight, &level, &diagonal)
    }

    /// The places to which an action leads from the set, whose places are in `rows`.
    fn after(&self, rows: RangeInclusive<i32>) -> Self {
        let [low, high] = [LOW[1], HIGH[1]].map(|y| y as usize);
        let near = (rows.start() - 3).max(LOW[1])..=(rows.end() + 3).min(HIGH[1]);
        let [straight, level, diagonal] = self.rows(
            rows,
            |row| columns_after::<-3>(row) | columns_after::<3>(row),
            |row| columns_after::<-2>(row) | columns_after::<2>(row),
        );
        let mut after = Places::gathered(near, &straight, &level, &diagonal);
        // Moves beyond the limits end at them.
        for (moved, most) in [(&straight, 3), (&diagonal, 2)] {
            after.0[low] |= moved[low..low + most].iter().fold(0, |all, row| all | row);
            after.0[high] |= moved[high + 1 - most..=high].iter().fold(0, |all, row| all | row);
        }
        after
    }

    /// Each of `rows` joined with the rows that straight, level and diagonal moves connect it with.
    fn gathered(rows: RangeInclusive<i32>, straight: &Rows, level: &Rows, diagonal: &Rows) -> Self {
        let mut places = Places::NONE;
        for y in rows.map(|y| y as usize) {
            places.0[y] = level[y] | straight[y - 3] | straight[y + 3] | diagonal[y - 2] | diagonal[y + 2];
        }
        places
    }

    /// The columns of `rows` after the [`MOVES`] that go straight up or down, stay in the row, or are diagonal.
    fn rows(
        &self,
        rows: RangeInclusive<i32>,
        aside: impl Fn(u128) -> u128,
        diagonal: impl Fn(u128) -> u128,
    ) -> [Rows; 3] {
        let mut moved = [[0; SCREEN]; 3];
        for y in rows.map(|y| y as usize) {
            let row = self.0[y] & WALKABLE;
            [moved[0][y], moved[1][y], moved[2][y]] = [row, row | aside(row), diagonal(row)];
        }
        moved
    }

    /// The place that is nearest to a goal.
    fn nearest(&self, goal: Goal) -> Option<Place> {
        self.iter().min_by_key(|place| goal.distance(*place))
    }

    fn iter(&self) -> impl Iterator<Item = Place> + '_ {
        (LOW[1]..=HIGH[1]).flat_map(move |y| {
            let mut row = self.0[y as usize] & WALKABLE;
            std::iter::from_fn(move || {
                let x = (row != 0).then(|| row.trailing_zeros() as i32)?;
                row &= row - 1;
                Some([x, y])
            })
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

    /// Adds all places within `reach` pixels of `centre` in `rows`, or none if none is in `columns`.
    pub fn add(&mut self, centre: [f64; 2], reach: f64, [columns, rows]: [RangeInclusive<i32>; 2]) {
        if centre[0] + reach < f64::from(*columns.start()) || centre[0] - reach > f64::from(*columns.end()) {
            return;
        }
        let [first, last] = [centre[1] - reach, centre[1] + reach + 1.0].map(|y| y as i32);
        for y in first.max(*rows.start())..=last.min(*rows.end()) {
            let rest = reach * reach - (f64::from(y) - centre[1]).powi(2);
            if rest >= 0.0 {
                let half = rest.sqrt();
                self.0.0[y as usize] |= bits((centre[0] - half).ceil() as i32, (centre[0] + half).floor() as i32);
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
        danger.add(self.place.map(f64::from), f64::from(self.reach), within(self.place, SCREEN));
        danger.0
    }
}

/// The next action of a path without a dangerous step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plan {
    pub action: [i32; 2],
    /// Whether the plan reaches the goal before the horizon.
    pub arrives: bool,
}

/// The first action of the path without a dangerous step up to the horizon that arrives at the goal first, or else ends nearest to
/// it; `None` if each path has one. `dangers` has an entry for the current step, which is ignored, and one for each future step.
pub(super) fn unharmed(start: Place, goal: Goal, dangers: &[Danger]) -> Option<Plan> {
    let start = moved(start, [0, 0]);
    // Whether a path can go on without a hit is needed only at the goal, and takes a pass over all later steps.
    let mut rest = None;
    let survivors =
        |step, there: Places| there.and(&rest.get_or_insert_with(|| survivable(start, step, dangers, None))[step]);
    let (reached, arrival) = walk(start, goal, dangers, None, survivors);
    let last = reached.len() - 1;
    let (step, place) = arrival.or_else(|| Some((last, reached[last].nearest(goal)?)))?;
    Some(Plan { action: first_action(step, place, 0, &[reached], dangers)?, arrives: arrival.is_some() })
}

/// The first action of the path with the fewest dangerous steps up to the horizon, at least one, and the nearest to the goal among
/// those actions.
pub(super) fn least_harmed(start: Place, goal: Goal, dangers: &[Danger]) -> [i32; 2] {
    let start = moved(start, [0, 0]);
    let next = MOVES.map(|(action, pixels)| (action, moved(start, pixels)));
    // With as many hits as steps, every path is possible.
    let mut allowed = survivable(start, 1, dangers, None);
    for _ in 1..dangers.len() {
        allowed = survivable(start, 1, dangers, Some(&allowed));
        let firsts = next.iter().filter(|(_, place)| allowed[1].contains(*place));
        if let Some((action, _)) = firsts.min_by_key(|(_, place)| goal.distance(*place)) {
            return *action;
        }
    }
    [0, 0]
}

/// For each step from `first`, the places within reach of `start` from which the rest of the path needs no dangerous step, or one
/// more than from the places of `easier`.
fn survivable(start: Place, first: usize, dangers: &[Danger], easier: Option<&[Places]>) -> Vec<Places> {
    let mut sets = vec![Places::NONE; dangers.len()];
    for step in (first..dangers.len()).rev() {
        let before = |sets: &[Places]| {
            let next = sets.get(step + 1);
            next.map_or(Places([u128::MAX; SCREEN]), |next| next.before(rows_within(start, step)))
        };
        sets[step] = before(&sets).without(&dangers[step].0);
        if let Some(easier) = easier {
            sets[step].extend(&before(easier).and(&dangers[step].0));
        }
    }
    sets
}

/// The first action of the path to the goal with the fewest dangerous steps, if one exists with at most `max_hits` of them.
/// Ignores what happens after the arrival.
pub(super) fn dash(start: Place, goal: Goal, dangers: &[Danger], max_hits: usize) -> Option<[i32; 2]> {
    let start = moved(start, [0, 0]);
    // For each number of dangerous steps.
    let mut reached: Vec<Vec<Places>> = Vec::new();
    for hits in 0..=max_hits {
        let (places, arrival) = walk(start, goal, dangers, reached.last().map(Vec::as_slice), |_, there| there);
        reached.push(places);
        if let Some((step, place)) = arrival {
            return first_action(step, place, hits, &reached, dangers);
        }
    }
    None
}

/// The places after each step on paths without a dangerous step, or on those with one more dangerous step than the paths of `easier`,
/// until one arrives at one of the goal's places that `accepted` keeps: after which step, and where.
fn walk(
    start: Place,
    goal: Goal,
    dangers: &[Danger],
    easier: Option<&[Places]>,
    mut accepted: impl FnMut(usize, Places) -> Places,
) -> (Vec<Places>, Option<(usize, Place)>) {
    let goals = goal.places();
    let mut places = vec![if easier.is_none() { Places::only(start) } else { Places::NONE }];
    for (step, danger) in dangers.iter().enumerate().skip(1) {
        let rows = rows_within(start, step - 1);
        let mut next = places[step - 1].after(rows.clone()).without(&danger.0);
        if let Some(easier) = easier {
            next.extend(&easier[step - 1].after(rows).and(&danger.0));
        }
        let there = next.clone().and(&goals);
        places.push(next);
        let arrival = if there.is_empty() { None } else { accepted(step, there).nearest(goal) };
        if let Some(place) = arrival {
            return (places, Some((step, place)));
        }
    }
    (places, None)
}

/// Traces a path back from its place after `step` steps with `hits` hits, and returns its first action.
fn first_action(
    mut step: usize,
    mut place: Place,
    mut hits: usize,
    reached: &[Vec<Places>],
    dangers: &[Danger],
) -> Option<[i32; 2]> {
    loop {
        hits -= usize::from(dangers[step].0.contains(place));
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
            let after = Places::only(start).after(LOW[1]..=HIGH[1]);
            let expected = MOVES.map(|(_, pixels)| moved(start, pixels));
            assert!(after.iter().all(|place| expected.contains(&place)), "{start:?}");
            for place in expected {
                assert!(after.contains(place), "{start:?} to {place:?}");
                assert!(Places::only(place).before(rows_within(start, 0)).contains(start), "{start:?} to {place:?}");
            }
        }
    }

    #[test]
    fn walks_straight_without_danger() {
        let dangers = vec![Danger::none(); HORIZON + 1];
        let goal = Goal { place: [70, 40], reach: 3 };
        let mut place = [20, 40];
        for _ in 0..16 {
            place = after(place, unharmed(place, goal, &dangers).unwrap().action);
        }
        assert!(goal.distance(place) <= 9, "{place:?}");
    }

    #[test]
    fn waits_for_a_wall_of_light_to_pass() {
        let wall = |step: usize| {
            let mut danger = Danger::none();
            if step < 12 {
                (0..84).step_by(4).for_each(|y| danger.add([40.0, f64::from(y)], 6.0, within([40, y], SCREEN)));
            }
            danger
        };
        let dangers: Vec<_> = (0..=HORIZON).map(wall).collect();
        let goal = Goal { place: [60, 40], reach: 3 };
        assert!(unharmed([30, 40], goal, &dangers).is_some());
        let surrounded = vec![Danger(Places([u128::MAX; SCREEN])); HORIZON + 1];
        assert!(unharmed([30, 40], goal, &surrounded).is_none());
        assert_eq!(least_harmed([30, 40], goal, &surrounded), [2, 0]);
    }
}
