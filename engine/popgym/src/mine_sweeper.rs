//! Mine Sweeper: view all squares without a mine; a viewed square says how many mines are around it.

use endless_gym_core::envs::{
    ActionSpace, Column, EnvSpec, Expert, ObservationSpace, Parameter, ParameterError, ResetParameters, StatePart,
    Task, Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::{Canvas, Rect};
use serde::{Deserialize, Serialize};

use crate::ids::{levels, shape};
use crate::pictures;

const DIFFICULTY: Parameter =
    Parameter::choice("difficulty", "easy", &["easy", "medium", "hard"], "size of the board and number of mines");
/// Most mines.
const MINES: usize = 10;

/// The board's size, and what follows from it.
#[derive(Clone)]
pub struct Parameters {
    size: usize,
    mines: usize,
    /// For each square, the bits of the squares within one step of it.
    around: Vec<u64>,
    max_steps: u32,
    viewed: f64,
    mine: f64,
    known: f64,
}

/// The state of an episode. Squares are bits, row by row.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MineSweeper {
    mines: u64,
    viewed: u64,
    steps: u32,
    /// Mines around the last square.
    count: u8,
}

impl Task for MineSweeper {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const FEATURES: &[Column] = &[Column { name: "mines", description: "mines on and around the last square" }];
        let summary = "View all squares without a mine; a viewed square says how many mines are around it";
        EnvSpec {
            features: FEATURES,
            needs_previous_action: true,
            arguments: &[DIFFICULTY],
            ..EnvSpec::new("MineSweeper", summary, ActionSpace::Discrete(1))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        levels::<Self>(Self::spec(), ["", "difficulty=medium", "difficulty=hard"])
    }

    fn with_arguments(spec: EnvSpec, &Parameters { size, mines, .. }: &Parameters) -> Result<EnvSpec, ParameterError> {
        let squares = "the squares, row by row: 0 not viewed, 1 a mine, 2 viewed";
        let state = vec![StatePart::integers("board", 3, shape(&[size * size]), "int8", squares)];
        Ok(EnvSpec {
            action_space: ActionSpace::MultiDiscrete(vec![size as i32; 2].into()),
            markov_state: state.leak(),
            observation_space: Some(ObservationSpace::Discrete(mines.min(9) as i32 + 1)),
            ..spec
        })
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let (size, mines) = match given.choice(DIFFICULTY.name) {
            "easy" => (4, 2),
            "medium" => (6, 6),
            _ => (8, MINES),
        };
        let squares = size * size;
        let near = |a: usize, b: usize| (a / size).abs_diff(b / size) <= 1 && (a % size).abs_diff(b % size) <= 1;
        let around = |of| (0..squares).filter(|square| near(of, *square)).fold(0, |bits, square| bits | 1 << square);
        let max_steps = squares - mines;
        let viewed = 1.0 / max_steps as f64;
        Parameters {
            size,
            mines,
            around: (0..squares).map(around).collect(),
            max_steps: max_steps as u32,
            viewed,
            mine: -0.5 - viewed,
            known: -0.5 / (max_steps - 2) as f64,
        }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        *self = MineSweeper::default();
        let mut mines = [0; MINES];
        let mines = &mut mines[..parameters.mines];
        random.choice_without_replacement(parameters.size * parameters.size, mines);
        self.mines = mines.iter().fold(0, |bits, mine| bits | 1 << *mine);
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        let square = action[0] as usize * parameters.size + action[1] as usize;
        let bit = 1 << square;
        let is_mine = self.mines & bit != 0;
        let reward = if is_mine {
            parameters.mine
        } else if self.viewed & bit != 0 {
            parameters.known
        } else {
            parameters.viewed
        };
        if !is_mine {
            self.viewed |= bit;
        }
        self.steps = self.steps.saturating_add(1);
        self.count = (self.mines & parameters.around[square]).count_ones() as u8;
        let terminated = is_mine || self.viewed.count_ones() == parameters.max_steps;
        Transition { reward, terminated, truncated: self.steps == parameters.max_steps && !terminated }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        out[0] = self.count.into();
    }

    fn markov_state(&self, _: &Parameters, out: &mut [f32]) {
        for (square, out) in out.iter_mut().enumerate() {
            *out = if self.mines >> square & 1 == 1 { 1.0 } else { 2.0 * f32::from(self.viewed >> square & 1 == 1) };
        }
    }

    fn paint(&self, _: &Parameters, canvas: &mut Canvas<'_>) {
        canvas.fill(pictures::GREY);
        canvas.draw_rect(pictures::PAPER, Rect::new(14, 14, 56, 56), 0);
        let color = [pictures::GREEN, pictures::BLUE, pictures::RED][usize::from(self.count.min(2))];
        pictures::digit(canvas, Rect::new(18, 18, 48, 48), self.count, color);
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        let squares = parameters.around.len();
        let board = u64::MAX >> (64 - squares);
        let is_last = |square: &usize| (self.mines | self.viewed) >> square & 1 == 1;
        let count = |square: usize| (self.mines & parameters.around[square]).count_ones() as u8;
        (self.mines | self.viewed) & !board == 0
            && self.mines & self.viewed == 0
            && self.mines.count_ones() as usize == parameters.mines
            && self.viewed.count_ones() <= self.steps
            && if self.steps == 0 {
                self.count == 0
            } else {
                (0..squares).filter(is_last).map(count).any(|of| of == self.count)
            }
    }

    fn expert(parameters: &Parameters) -> Option<Box<dyn Expert>> {
        let counts = vec![None; parameters.around.len()];
        Some(Box::new(Solver { counts, parameters: parameters.clone(), last: None }))
    }
}

/// Views the square that is least likely a mine. The probabilities are fitted to all counts, one count after the other.
struct Solver {
    parameters: Parameters,
    /// Mines around each viewed square.
    counts: Vec<Option<f64>>,
    last: Option<usize>,
}

impl Solver {
    const ROUNDS: usize = 100;

    /// Probabilities of mines.
    fn probabilities(&self) -> Vec<f64> {
        let squares = self.counts.len();
        let closed = |around: u64| {
            (0..squares).filter(move |square| around >> square & 1 == 1 && self.counts[*square].is_none())
        };
        let counts = self.counts.iter().zip(&self.parameters.around);
        let mut sums: Vec<(f64, Vec<usize>)> =
            counts.filter_map(|(count, around)| Some(((*count)?, closed(*around).collect()))).collect();
        sums.push((self.parameters.mines as f64, closed(u64::MAX).collect()));
        let mut mines = vec![0.5; squares];
        for (sum, squares) in (0..Self::ROUNDS).flat_map(|_| &sums) {
            let scale = sum / squares.iter().map(|square| mines[*square]).sum::<f64>().max(f64::MIN_POSITIVE);
            squares.iter().for_each(|square| mines[*square] = (mines[*square] * scale).min(1.0));
        }
        mines
    }
}

impl Expert for Solver {
    fn reset(&mut self) {
        self.counts.fill(None);
        self.last = None;
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        if let Some(last) = self.last {
            self.counts[last] = Some(features[0].into());
        }
        let mines = self.probabilities();
        let closed = (0..mines.len()).filter(|square| self.counts[*square].is_none());
        let square = closed.min_by(|a, b| mines[*a].total_cmp(&mines[*b])).unwrap_or_default();
        self.last = Some(square);
        let size = self.parameters.size;
        (action[0], action[1]) = ((square / size) as i32, (square % size) as i32);
    }
}
