//! The expert's belief about a hidden path: the probability that a tile is on it, given the observations.
//!
//! The belief is a set of sample paths, generated as in the rules. Samples that contradict an observation are removed.

use std::sync::OnceLock;

use super::parameters::Variant;
use super::path::{GRID, Path, Tile, TileSet, draw_ends};
use endless_gym_core::random::Generator;

/// Number of sample paths for each tile that a path can start on.
const SAMPLES: usize = 16_384;

/// Weight of the prior, in samples. The prior decides if no sample is left.
const PRIOR_WEIGHT: f64 = 4.0;

/// The sample paths that agree with all observations.
#[derive(Clone, Debug)]
pub struct Belief {
    samples: Vec<TileSet>,
}

impl Belief {
    /// All samples that start at `start`: on one grid, and for the endless id including the tile that leads to the next grid.
    pub fn new(variant: Variant, start: Tile) -> Self {
        static FINITE: [OnceLock<Vec<TileSet>>; 64] = [const { OnceLock::new() }; 64];
        static ENDLESS: [OnceLock<Vec<TileSet>>; 8] = [const { OnceLock::new() }; 8];
        let (x, y) = (start.0.clamp(0, GRID - 1), start.1.clamp(0, GRID - 1));
        let samples = match variant {
            Variant::Free | Variant::Grid => &FINITE[(x * 8 + y) as usize],
            Variant::Endless => &ENDLESS[y as usize],
        };
        Belief { samples: samples.get_or_init(|| sample_paths(variant, (x, y))).clone() }
    }

    /// Removes the samples that contradict whether a tile is on the path.
    pub fn observe(&mut self, tile: Tile, on_path: bool) {
        self.samples.retain(|path| path.contains(tile) == on_path);
    }

    /// The probability that a tile is on the path. `prior` is the probability without any samples, and has the weight of
    /// [`PRIOR_WEIGHT`] samples.
    pub fn probability(&self, tile: Tile, prior: f64) -> f64 {
        let on_path = self.samples.iter().filter(|path| path.contains(tile)).count();
        (on_path as f64 + PRIOR_WEIGHT * prior) / (self.samples.len() as f64 + PRIOR_WEIGHT)
    }
}

fn sample_paths(variant: Variant, start: Tile) -> Vec<TileSet> {
    let mut random = Generator::from_seed(1);
    let last = GRID - 1;
    // The sides on which the path can start; a corner lies on two.
    let on_side = [start.0 == 0, start.0 == last, start.1 == 0, start.1 == last];
    let sides: Vec<i64> = match variant {
        Variant::Free | Variant::Grid => (0..).zip(on_side).filter_map(|(side, on)| on.then_some(side)).collect(),
        Variant::Endless => vec![0],
    };
    if sides.is_empty() {
        return Vec::new();
    }
    let sample_path = |_| {
        let (_, end) = draw_ends(*random.choice(&sides), &mut random);
        let mut tiles = TileSet::default();
        Path::generate(start, end, &mut random).tiles().for_each(|tile| tiles.insert(tile));
        if variant == Variant::Endless {
            tiles.insert((GRID, end.1));
        }
        tiles
    };
    (0..SAMPLES).map(sample_path).collect()
}
