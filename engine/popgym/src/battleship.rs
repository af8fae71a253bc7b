//! Battleship: find hidden ships; a shot only says whether it hit.

use std::array;

use endless_gym_core::envs::{
    ActionSpace, Column, EnvSpec, Expert, ObservationSpace, Parameter, ParameterError, ResetParameters, StatePart,
    Task, Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;
use serde::{Deserialize, Serialize};

use crate::ids::{levels, shape};
use crate::pictures;

const ARGUMENTS: &[Parameter] = &[
    Parameter::int("board_size", 10, 1, ROWS as i64, "rows and columns of the board"),
    Parameter::list("ship_sizes", &[2, 3, 3, 4], 1, ROWS as i64, "squares of each of at most 8 ships"),
];
/// The largest board's size.
const ROWS: usize = 20;
/// Most ships, of which each one more multiplies the time of [`are_ships`].
const SHIPS: usize = 8;

/// The board's size, the ships, the squares that they cover, and the rewards.
pub struct Parameters {
    size: usize,
    ships: Vec<i64>,
    covered: i32,
    hit: f64,
    miss: f64,
}

/// The state of an episode. The bits of a row are its columns.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Battleship {
    ships: [u32; ROWS],
    shots: [u32; ROWS],
    hits: i32,
    steps: i32,
    is_hit: bool,
}

impl Battleship {
    /// Places a ship where it fits, by drawing until it does.
    fn place_ship(&mut self, board: i64, ship: i64, random: &mut Generator) {
        loop {
            let start = [random.integers(0, board), random.integers(0, board)];
            let (axis, backwards) = (random.integers(0, 2) as usize, random.integers(0, 2) == 1);
            let mut end = start;
            end[axis] += if backwards { 1 - ship } else { ship - 1 };
            if !(0..board).contains(&end[axis]) {
                continue;
            }
            let (top, bottom) = (start[0].min(end[0]) as usize, start[0].max(end[0]) as usize);
            let (left, right) = (start[1].min(end[1]), start[1].max(end[1]));
            let columns = ((1_u32 << (right - left + 1)) - 1) << left;
            if self.ships[top..=bottom].iter().all(|row| row & columns == 0) {
                self.ships[top..=bottom].iter_mut().for_each(|row| *row |= columns);
                return;
            }
        }
    }
}

/// Whether there is room for each ship wherever those before it are, so that drawing places comes to an end.
fn has_room(size: i64, ships: &[i64]) -> bool {
    let is_large = ships.iter().enumerate().all(|(number, ship)| {
        // Places side by side in a row or column. Another ship takes one in each row that it crosses, and those that it lies on.
        let places = size / ship;
        let taken = ships[..number].iter().map(|other| other + places.min((other - 2).div_euclid(*ship) + 2));
        taken.sum::<i64>() < 2 * size * places
    });
    is_large || size <= 8 && !can_block(size, 0, ships, &mut 200_000)
}

/// Whether ships that are placed one after the other can leave no place for the next. If `work` is used up, they may.
fn can_block(size: i64, taken: u64, ships: &[i64], work: &mut u32) -> bool {
    let Some((ship, rest)) = ships.split_first() else { return false };
    *work = work.saturating_sub(1);
    let lines = [1, size].into_iter().flat_map(|step| (0..size * size).map(move |start| (step, start)));
    let places = lines.filter_map(|(step, start)| {
        let from_edge = if step == 1 { start % size } else { start / size };
        let squares =
            (0..*ship).fold(0, |squares, at| squares | 1_u64.checked_shl((start + at * step) as u32).unwrap_or(0));
        (from_edge + ship <= size && squares & taken == 0).then_some(squares)
    });
    let mut places = places.peekable();
    *work == 0 || places.peek().is_none() || places.any(|place| can_block(size, taken | place, rest, work))
}

/// Whether these ships, side by side, can cover exactly these squares.
fn are_ships(squares: [u32; ROWS], ships: &[i64]) -> bool {
    let Some(row) = squares.iter().position(|bits| *bits != 0) else { return ships.is_empty() };
    // Some ship has its top or left end at the first square.
    let column = squares[row].trailing_zeros();
    ships.iter().enumerate().any(|(number, ship)| {
        let others = [&ships[..number], &ships[number + 1..]].concat();
        !ships[..number].contains(ship)
            && [(1, *ship), (*ship, 1)].into_iter().any(|(height, width)| {
                let (columns, mut rest) = (((1_u64 << width) - 1) << column, squares);
                let covered = rest
                    .iter_mut()
                    .skip(row)
                    .take(height as usize)
                    .filter(|bits| u64::from(**bits) & columns == columns);
                covered.map(|bits| *bits &= !columns as u32).count() == height as usize && are_ships(rest, &others)
            })
    })
}

impl Task for Battleship {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const FEATURES: &[Column] = &[Column { name: "hit", description: "1 if the last shot hit, otherwise 0" }];
        let summary = "Find hidden ships; a shot only says whether it hit";
        EnvSpec {
            features: FEATURES,
            needs_previous_action: true,
            observation_space: Some(ObservationSpace::Discrete(2)),
            arguments: ARGUMENTS,
            ..EnvSpec::new("Battleship", summary, ActionSpace::Discrete(1))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        levels::<Self>(Self::spec(), ["board_size=8", "", "board_size=12"])
    }

    fn with_arguments(spec: EnvSpec, parameters: &Parameters) -> Result<EnvSpec, ParameterError> {
        let Parameters { size, ships, covered, .. } = parameters;
        let squares = (size * size) as i32;
        if ships.len() > SHIPS || *covered >= squares || !has_room(*size as i64, ships) {
            let allowed = format!("at most {SHIPS} ships that always fit on a board of {size}×{size} squares");
            return Err(ParameterError::Argument { name: "ship_sizes", value: format!("{ships:?}"), allowed });
        }
        let board = shape(&[*size; 2]);
        let state = vec![
            StatePart::integers("ships", 2, board, "int8", "1 where a ship is"),
            StatePart::integers("shots", 2, board, "int8", "1 where the agent has shot"),
            StatePart::integer("hit", 2, "1 if the last shot hit, otherwise 0"),
        ];
        let action_space = ActionSpace::MultiDiscrete(vec![*size as i32; 2].into());
        Ok(EnvSpec { action_space, markov_state: state.leak(), ..spec })
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let (size, ships) = (given.int("board_size", 1) as usize, given.int_list("ship_sizes"));
        let covered = ships.iter().sum::<i64>() as i32;
        let misses = (size * size) as i32 - covered;
        Parameters { size, ships, covered, hit: 1.0 / f64::from(covered), miss: -1.0 / f64::from(misses) }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        *self = Battleship::default();
        for ship in &parameters.ships {
            self.place_ship(parameters.size as i64, *ship, random);
        }
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        let (row, column) = (action[0] as usize, 1 << action[1]);
        self.is_hit = self.ships[row] & !self.shots[row] & column != 0;
        self.shots[row] |= column;
        self.hits += i32::from(self.is_hit);
        self.steps = self.steps.saturating_add(1);
        Transition {
            reward: if self.is_hit { parameters.hit } else { parameters.miss },
            terminated: self.hits == parameters.covered,
            truncated: self.steps as usize >= parameters.size * parameters.size,
        }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        out[0] = f32::from(u8::from(self.is_hit));
    }

    fn markov_state(&self, parameters: &Parameters, out: &mut [f32]) {
        let boards = [self.ships, self.shots];
        let rows = boards.iter().flat_map(|board| &board[..parameters.size]);
        let squares = rows.flat_map(|row| (0..parameters.size).map(move |column| row >> column & 1));
        let last = squares.chain([self.is_hit.into()]);
        out.iter_mut().zip(last).for_each(|(out, bit)| *out = bit as f32);
    }

    /// Fire after a hit, rings in the water otherwise.
    fn paint(&self, _: &Parameters, canvas: &mut Canvas<'_>) {
        canvas.fill(pictures::BLUE);
        if self.is_hit {
            canvas.draw_circle(pictures::RED, (42, 42), 28, 0);
            canvas.draw_circle(pictures::GOLD, (42, 42), 16, 0);
        } else {
            [12, 22, 32].iter().for_each(|radius| canvas.draw_circle(pictures::PAPER, (42, 42), *radius, 2));
        }
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        let count = |rows: &[u32; ROWS]| rows.iter().map(|row| row.count_ones() as i32).sum::<i32>();
        let (hits, shots) = (array::from_fn(|row| self.ships[row] & self.shots[row]), count(&self.shots));
        let is_on_board =
            |(row, bits): (usize, &u32)| row < parameters.size && bits >> parameters.size == 0 || *bits == 0;
        [self.ships, self.shots].iter().all(|board| board.iter().enumerate().all(is_on_board))
            && are_ships(self.ships, &parameters.ships)
            && self.hits == count(&hits)
            && shots <= self.steps
            && (shots == 0) == (self.steps == 0)
            // Every shot but the first at a square misses.
            && if self.is_hit { self.hits > 0 } else { self.steps == 0 || self.hits < self.steps }
    }

    fn expert(Parameters { size, ships, .. }: &Parameters) -> Option<Box<dyn Expert>> {
        let ships = ships.iter().map(|ship| *ship as usize).collect();
        Some(Box::new(Hunter { size: *size, ships, shots: vec![None; size * size], last: None }))
    }
}

/// Shoots where most placements of the ships fit its shots. Each hit that a placement covers makes it [`Hunter::HIT`] times as likely.
struct Hunter {
    size: usize,
    ships: Vec<usize>,
    /// Whether the shot at each square hit.
    shots: Vec<Option<bool>>,
    last: Option<usize>,
}

impl Hunter {
    const HIT: f64 = 6.0;

    /// The squares of a ship that starts at a square, if it is on the board and no shot missed it there.
    fn placement(&self, start: usize, ship: usize, is_vertical: bool) -> Option<Vec<usize>> {
        let (row, column) = (start / self.size, start % self.size);
        let fits = ship + if is_vertical { row } else { column } <= self.size;
        let squares: Vec<usize> = (0..ship).map(|at| start + at * if is_vertical { self.size } else { 1 }).collect();
        (fits && squares.iter().all(|square| self.shots[*square] != Some(false))).then_some(squares)
    }
}

impl Expert for Hunter {
    fn reset(&mut self) {
        self.shots.fill(None);
        self.last = None;
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        if let Some(last) = self.last {
            self.shots[last] = Some(features[0] == 1.0);
        }
        let mut scores = vec![0.0; self.shots.len()];
        for (start, ship) in (0..self.shots.len()).flat_map(|start| self.ships.iter().map(move |ship| (start, ship))) {
            for squares in [false, true].into_iter().filter_map(|is_vertical| self.placement(start, *ship, is_vertical))
            {
                let hits = squares.iter().filter(|square| self.shots[**square].is_some()).count();
                squares.iter().for_each(|square| scores[*square] += Self::HIT.powi(hits as i32));
            }
        }
        let open = (0..scores.len()).filter(|square| self.shots[*square].is_none());
        let square = open.max_by(|a, b| scores[*a].total_cmp(&scores[*b])).unwrap_or_default();
        self.last = Some(square);
        (action[0], action[1]) = ((square / self.size) as i32, (square % self.size) as i32);
    }
}
