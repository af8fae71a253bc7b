//! What the experts expect of a path that they cannot see: how likely a tile is on it, after all that was found out.
//!
//! They know the rules by which paths are generated, so they compare what they found with paths of their own making.

use std::sync::OnceLock;

use super::parameters::Variant;
use super::path::{GRID, Path, Tile, TileSet};
use super::rules::draw_ends;
use crate::random::Generator;

/// Paths that an expert imagines for each tile that a path can begin on.
const IMAGINED: usize = 16_384;

/// Imagined paths that a guess outweighs: few, but more than the none that may be left.
const GUESSES: f64 = 4.0;

/// The paths that are still possible, of those that were imagined.
#[derive(Clone, Debug)]
pub struct Belief {
    possible: Vec<TileSet>,
}

impl Belief {
    /// Anything that can begin at `start`: on one grid, and for the endless id with the tile that leads to the next.
    pub fn new(variant: Variant, start: Tile) -> Self {
        static FINITE: [OnceLock<Vec<TileSet>>; 64] = [const { OnceLock::new() }; 64];
        static ENDLESS: [OnceLock<Vec<TileSet>>; 8] = [const { OnceLock::new() }; 8];
        let (x, y) = (start.0.clamp(0, GRID - 1), start.1.clamp(0, GRID - 1));
        let imagined = match variant {
            Variant::Free | Variant::Grid => &FINITE[(x * 8 + y) as usize],
            Variant::Endless => &ENDLESS[y as usize],
        };
        Belief { possible: imagined.get_or_init(|| imagine(variant, (x, y))).clone() }
    }

    /// Learns that a tile is on the path, or that it is not.
    pub fn learn(&mut self, tile: Tile, on_path: bool) {
        self.possible.retain(|path| path.contains(tile) == on_path);
    }

    /// The chance that a tile is on the path, 0 to 1. `guess` is what to think without any imagined path, and counts as much as
    /// [`GUESSES`] of them.
    pub fn chance(&self, tile: Tile, guess: f64) -> f64 {
        let on_path = self.possible.iter().filter(|path| path.contains(tile)).count();
        (on_path as f64 + GUESSES * guess) / (self.possible.len() as f64 + GUESSES)
    }
}

fn imagine(variant: Variant, start: Tile) -> Vec<TileSet> {
    let mut random = Generator::from_seed(1);
    let last = GRID - 1;
    // The sides that the path can begin on; a corner lies on two.
    let on_side = [start.0 == 0, start.0 == last, start.1 == 0, start.1 == last];
    let sides: Vec<i64> = match variant {
        Variant::Free | Variant::Grid => (0..).zip(on_side).filter_map(|(side, on)| on.then_some(side)).collect(),
        Variant::Endless => vec![0],
    };
    if sides.is_empty() {
        return Vec::new();
    }
    let imagine_one = |_| {
        let (_, end) = draw_ends(*random.choice(&sides), &mut random);
        let mut tiles = TileSet::default();
        Path::generate(start, end, &mut random).tiles().for_each(|tile| tiles.insert(tile));
        if variant == Variant::Endless {
            tiles.insert((GRID, end.1));
        }
        tiles
    };
    (0..IMAGINED).map(imagine_one).collect()
}
