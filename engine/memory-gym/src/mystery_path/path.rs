//! Path generation: random walls, then a search for a path around them.
//!
//! Source: `Node` and `MysteryPath` of the original's `pygame_assets.py`. The original's A* search deviates from the textbook,
//! and this one reproduces its deviations and the order of its random draws: the search expands the first tile of the open list
//! with a lower score than the list's first tile, the cost of each step is a random number, and a cheaper path to an open tile
//! changes the tile's parent but not its cost.

use serde::{Deserialize, Serialize};

use endless_gym_core::random::Generator;

/// Number of columns and rows of the grid that a path is generated on.
pub const GRID: i32 = 7;

/// Chance in percent that an inner tile is a wall.
const WALL_PERCENT: i64 = 33;
/// Choices for the number of walls that are added on the grid's border, if there is room.
const BORDER_WALLS: [u32; 2] = [4, 8];
/// Range of the random cost of a search step, `LOWEST_COST..COST_END`.
const LOWEST_COST: i64 = 1;
const COST_END: i64 = 9;

/// Column and row, from the top left.
pub type Tile = (i32, i32);

/// A set of tiles, column by column: the tile `(x, y)` is the bit `8 x + y`.
///
/// A grid has seven rows. The eighth row is always empty, so that no step leads from the end of one column to the start of the
/// next. The eighth column holds the tile that joins two grids.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TileSet(u64);

impl TileSet {
    pub const GRID: TileSet = TileSet(0x007f_7f7f_7f7f_7f7f);
    const BORDER: TileSet = TileSet(0x007f_4141_4141_417f);

    /// The set of one tile; empty if the tile is outside the eight columns and seven rows.
    pub fn of((x, y): Tile) -> Self {
        let inside = (0..=GRID).contains(&x) && (0..GRID).contains(&y);
        if inside { TileSet(1 << index((x, y))) } else { TileSet(0) }
    }

    /// Whether the tile is in the set.
    pub fn contains(self, tile: Tile) -> bool {
        self.0 & TileSet::of(tile).0 != 0
    }

    /// Adds a tile.
    pub fn insert(&mut self, tile: Tile) {
        self.0 |= TileSet::of(tile).0;
    }

    /// The tiles, column by column.
    pub fn iter(self) -> impl Iterator<Item = Tile> {
        let mut rest = self.0;
        std::iter::from_fn(move || {
            let index = (rest != 0).then(|| rest.trailing_zeros())?;
            rest &= rest - 1;
            Some(tile(index as u8))
        })
    }

    /// Number of tiles.
    pub fn count(self) -> usize {
        self.0.count_ones() as usize
    }

    /// Whether all tiles are in the other set.
    pub fn is_subset(self, other: TileSet) -> bool {
        self.0 & !other.0 == 0
    }

    fn holds(self, index: u8) -> bool {
        self.0 >> index & 1 == 1
    }

    /// The tiles to the left, right, above and below.
    fn beside(self) -> TileSet {
        TileSet((self.0 << 8 | self.0 >> 8 | self.0 << 1 | self.0 >> 1) & TileSet::GRID.0)
    }

    /// The tiles themselves and the eight tiles around each.
    fn around(self) -> TileSet {
        let columns = self.0 | self.0 << 8 | self.0 >> 8;
        TileSet((columns | columns << 1 | columns >> 1) & TileSet::GRID.0)
    }

    /// Removes and returns the tile number `number`, counted column by column.
    fn take(&mut self, number: u32) -> TileSet {
        let mut rest = self.0;
        for _ in 0..number {
            rest &= rest - 1;
        }
        let taken = rest & rest.wrapping_neg();
        self.0 &= !taken;
        TileSet(taken)
    }
}

/// Maximum number of tiles in a path.
const MAX_LENGTH: usize = (GRID * GRID) as usize;

fn index((x, y): Tile) -> u8 {
    (x * 8 + y) as u8
}

fn tile(index: u8) -> Tile {
    (i32::from(index / 8), i32::from(index % 8))
}

/// A generated path, and the walls that it avoids.
#[derive(Clone, Debug)]
pub struct Path {
    /// The walls, which the finite ids' ground-truth view shows.
    pub walls: TileSet,
    /// Tiles from the end back to the start.
    backwards: [u8; MAX_LENGTH],
    length: usize,
}

impl Path {
    /// Generates a path between two tiles of the grid's border.
    pub fn generate(start: Tile, end: Tile, random: &mut Generator) -> Path {
        let mut walls = TileSet::default();
        // The last inner column and row are never walls.
        for x in 1..GRID - 2 {
            for y in 1..GRID - 2 {
                if random.integers(0, 100) < WALL_PERCENT {
                    walls.insert((x, y));
                }
            }
        }
        let ends = TileSet(TileSet::of(start).0 | TileSet::of(end).0);
        let mut candidates = TileSet(TileSet::BORDER.0 & !(ends.0 | ends.beside().0 | walls.around().0));
        for _ in 0..*random.choice(&BORDER_WALLS) {
            let count = candidates.0.count_ones();
            if count > 0 {
                walls.0 |= candidates.take(random.integers(0, i64::from(count)) as u32).0;
            }
        }
        search(start, end, walls, random)
    }

    /// The tiles from start to end.
    pub fn tiles(&self) -> impl Iterator<Item = Tile> {
        self.backwards[..self.length].iter().rev().map(|index| tile(*index))
    }
}

/// Draws the first and the last tile of a path: on the given side of the grid (0 left, 1 right, 2 top, others bottom), and on
/// the opposite side.
pub fn draw_ends(side: i64, random: &mut Generator) -> (Tile, Tile) {
    let first = random.integers(0, i64::from(GRID)) as i32;
    let second = random.integers(0, i64::from(GRID)) as i32;
    let last = GRID - 1;
    match side {
        0 => ((0, first), (last, second)),
        1 => ((last, first), (0, second)),
        2 => ((first, 0), (second, last)),
        _ => ((first, last), (second, 0)),
    }
}

/// Searches for a path around the walls. One always exists: a wall on the border has no inner wall next to it, so a path along
/// the border can go around it.
fn search(start: Tile, end: Tile, walls: TileSet, random: &mut Generator) -> Path {
    const NOWHERE: u8 = u8::MAX;
    let (start, end, goal) = (index(start), index(end), end);
    let distance = |index: u8| {
        let (x, y) = tile(index);
        f64::from((x - goal.0).pow(2) + (y - goal.1).pow(2)).sqrt()
    };
    let mut costs = [0_i64; 64];
    let mut parent = [NOWHERE; 64];
    // Score and tile are stored together, since every search of the list reads all scores.
    let mut open_list = [(0.0_f64, 0_u8); MAX_LENGTH];
    open_list[0] = (0.0, start);
    let mut open_count = 1;
    let mut open = TileSet(1 << start);
    // Walls and tiles outside the grid count as closed, so they are never entered.
    let mut closed = TileSet(walls.0 | !TileSet::GRID.0);
    while open_count > 0 {
        let list = &open_list[..open_count];
        let (first, _) = list[0];
        let winner = list.iter().position(|(score, _)| *score < first).unwrap_or(0);
        let (_, current) = list[winner];
        if current == end {
            break;
        }
        open_list.copy_within(winner + 1..open_count, winner);
        open_count -= 1;
        open.0 &= !(1 << current);
        closed.0 |= 1 << current;
        // A step off the grid gives an index outside 0..64 or in the empty row.
        for next in [current + 8, current.wrapping_sub(8), current + 1, current.wrapping_sub(1)] {
            if next >= 64 || closed.holds(next) {
                continue;
            }
            let place = usize::from(next);
            let cost = costs[usize::from(current)] + random.integers(LOWEST_COST, COST_END);
            if !open.holds(next) {
                costs[place] = cost;
                open.0 |= 1 << next;
                open_list[open_count] = (cost as f64 + distance(next), next);
                open_count += 1;
            } else if cost >= costs[place] {
                continue;
            }
            parent[place] = current;
        }
    }
    let mut path = Path { walls, backwards: [0; MAX_LENGTH], length: 0 };
    let mut at = end;
    while at != NOWHERE && path.length < MAX_LENGTH {
        path.backwards[path.length] = at;
        path.length += 1;
        at = parent[usize::from(at)];
    }
    path
}

#[cfg(test)]
mod tests {
    use super::TileSet;

    /// A forged snapshot may hold any numbers.
    #[test]
    fn sets_hold_no_tile_outside() {
        for outside in [(-1, 0), (8, 0), (0, -1), (0, 7), (i32::MAX, 3), (3, i32::MIN)] {
            assert_eq!(TileSet::of(outside), TileSet::default(), "{outside:?}");
        }
        assert!(TileSet::of((7, 6)).contains((7, 6)));
    }
}
