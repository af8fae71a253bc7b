//! Mine Sweeper: view all squares without a mine; a viewed square says how many mines are around it.

use endless_gym_core::envs::{ActionSpace, Column, EnvSpec, ObservationSpace, ResetParameters, Task, Transition};
use endless_gym_core::random::Generator;
use serde::{Deserialize, Serialize};

use crate::ids::{ids, place};

const IDS: [&str; 3] = ids!("MineSweeper");
/// The board's size, and the number of mines.
const VARIANTS: [(usize, usize); 3] = [(4, 2), (6, 6), (8, 10)];
/// Most mines.
const MINES: usize = 10;

/// The board's size, and what follows from it.
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
        Self::specs().swap_remove(0)
    }

    fn specs() -> Vec<EnvSpec> {
        const FEATURES: &[Column] = &[Column { name: "mines", description: "mines on and around the last square" }];
        let spec = |(id, (size, mines)): (_, (usize, usize))| {
            let summary = "View all squares without a mine; a viewed square says how many mines are around it";
            let actions = ActionSpace::MultiDiscrete(vec![size as i32; 2].into());
            EnvSpec {
                features: FEATURES,
                observation_space: Some(ObservationSpace::Discrete(mines.min(9) as i32 + 1)),
                ..EnvSpec::new(id, summary, actions)
            }
        };
        IDS.into_iter().zip(VARIANTS).map(spec).collect()
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let (size, mines) = VARIANTS[place(&IDS, given.id())];
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
}
