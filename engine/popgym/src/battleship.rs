//! Battleship: find hidden ships; a shot only says whether it hit.

use std::array;

use endless_gym_core::envs::{
    ActionSpace, Column, EnvSpec, Expert, ObservationSpace, ResetParameters, StatePart, Task, Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;
use serde::{Deserialize, Serialize};

use crate::ids::{ids, place, shape};
use crate::pictures::{self, PICTURE};

const IDS: [&str; 3] = ids!("Battleship");
const SIZES: [usize; 3] = [8, 10, 12];
const SHIPS: [i64; 4] = [2, 3, 3, 4];
/// Squares that ships cover.
const COVERED: i32 = 12;
/// The largest board's size.
const ROWS: usize = 12;

/// The board's size, and the rewards.
pub struct Parameters {
    size: usize,
    hit: f64,
    miss: f64,
}

/// The state of an episode. The bits of a row are its columns.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Battleship {
    ships: [u16; ROWS],
    shots: [u16; ROWS],
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
            let columns = ((1_u16 << (right - left + 1)) - 1) << left;
            if self.ships[top..=bottom].iter().all(|row| row & columns == 0) {
                self.ships[top..=bottom].iter_mut().for_each(|row| *row |= columns);
                return;
            }
        }
    }
}

/// Whether these ships, side by side, can cover exactly these squares.
fn are_ships(squares: [u16; ROWS], ships: &[i64]) -> bool {
    let Some(row) = squares.iter().position(|bits| *bits != 0) else { return ships.is_empty() };
    // Some ship has its top or left end at the first square.
    let column = squares[row].trailing_zeros();
    ships.iter().enumerate().any(|(number, ship)| {
        let others = [&ships[..number], &ships[number + 1..]].concat();
        [(1, *ship), (*ship, 1)].into_iter().any(|(height, width)| {
            let (columns, mut rest) = (((1_u16 << width) - 1) << column, squares);
            let covered = rest.iter_mut().skip(row).take(height as usize).filter(|bits| **bits & columns == columns);
            covered.map(|bits| *bits &= !columns).count() == height as usize && are_ships(rest, &others)
        })
    })
}

impl Task for Battleship {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        Self::specs().swap_remove(0)
    }

    fn specs() -> Vec<EnvSpec> {
        const FEATURES: &[Column] = &[Column { name: "hit", description: "1 if the last shot hit, otherwise 0" }];
        let spec = |(id, size): (_, usize)| {
            let summary = "Find hidden ships; a shot only says whether it hit";
            let actions = ActionSpace::MultiDiscrete(vec![size as i32; 2].into());
            let board = shape(&[size, size]);
            let state = vec![
                StatePart::integers("ships", 2, board, "int8", "1 where a ship is"),
                StatePart::integers("shots", 2, board, "int8", "1 where the agent has shot"),
                StatePart::integer("hit", 2, "1 if the last shot hit, otherwise 0"),
            ];
            EnvSpec {
                features: FEATURES,
                markov_state: state.leak(),
                needs_previous_action: true,
                observation_space: Some(ObservationSpace::Discrete(2)),
                picture: Some(PICTURE),
                ..EnvSpec::new(id, summary, actions)
            }
        };
        IDS.into_iter().zip(SIZES).map(spec).collect()
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let size = SIZES[place(&IDS, given.id())];
        let misses = (size * size) as i32 - COVERED;
        Parameters { size, hit: 1.0 / f64::from(COVERED), miss: -1.0 / f64::from(misses) }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        *self = Battleship::default();
        for ship in SHIPS {
            self.place_ship(parameters.size as i64, ship, random);
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
            terminated: self.hits == COVERED,
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
        out.iter_mut().zip(last).for_each(|(out, bit)| *out = bit.into());
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
        let count = |rows: &[u16; ROWS]| rows.iter().map(|row| row.count_ones() as i32).sum::<i32>();
        let (hits, shots) = (array::from_fn(|row| self.ships[row] & self.shots[row]), count(&self.shots));
        let is_on_board =
            |(row, bits): (usize, &u16)| row < parameters.size && bits >> parameters.size == 0 || *bits == 0;
        [self.ships, self.shots].iter().all(|board| board.iter().enumerate().all(is_on_board))
            && are_ships(self.ships, &SHIPS)
            && self.hits == count(&hits)
            && shots <= self.steps
            && (shots == 0) == (self.steps == 0)
            // Every shot but the first at a square misses.
            && if self.is_hit { self.hits > 0 } else { self.steps == 0 || self.hits < self.steps }
    }

    fn expert(id: &str) -> Option<Box<dyn Expert>> {
        let size = SIZES[place(&IDS, id)];
        Some(Box::new(Hunter { size, shots: vec![None; size * size], last: None }))
    }
}

/// Shoots where most placements of the ships fit its shots. Each hit that a placement covers makes it [`Hunter::HIT`] times as likely.
struct Hunter {
    size: usize,
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
        for (start, ship) in (0..self.shots.len()).flat_map(|start| SHIPS.map(|ship| (start, ship as usize))) {
            for squares in [false, true].into_iter().filter_map(|is_vertical| self.placement(start, ship, is_vertical))
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
