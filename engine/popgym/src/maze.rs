//! Mazes by the hunt-and-kill algorithm of the Python package mazelib 0.9.16, from which the original takes them.

use endless_gym_core::random::{Generator, MersenneTwister};
use serde::{Deserialize, Serialize};

/// A square.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// From 0 at the top.
    pub row: usize,
    /// From 0 on the left.
    pub column: usize,
}

/// A maze. Cells, at odd rows and columns, are separated by walls or passages.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Maze {
    /// Bits of rows: 1 for a wall.
    walls: Vec<u64>,
    columns: usize,
    /// Where the agent starts, in the outer wall.
    pub start: Place,
    /// The exit, in the opposite wall.
    pub goal: Place,
    /// The generators that the original shares among all mazes of a process: Python's, and numpy's.
    random: Option<(MersenneTwister, MersenneTwister)>,
}

impl Maze {
    /// Seeds the maze's generators.
    pub fn seed(&mut self, seed: u64) {
        // The original refuses seeds of more than 32 bits.
        let of_numpy = seed as u32;
        let (python, numpy) = self.random.get_or_insert_with(|| {
            (MersenneTwister::from_python_seed(seed), MersenneTwister::from_numpy_seed(of_numpy))
        });
        python.seed_as_python(seed);
        numpy.seed_as_numpy(of_numpy);
    }

    /// Makes a maze of so many rows and columns of cells. `random` seeds the maze's generators if nothing else has.
    pub fn generate(&mut self, [rows, columns]: [usize; 2], random: &mut Generator) {
        if self.random.is_none() {
            self.seed(random.integers(0, 1 << 32) as u64);
        }
        let Some((mut python, mut numpy)) = self.random.take() else { return };
        self.columns = 2 * columns + 1;
        self.walls.clear();
        self.walls.resize(2 * rows + 1, u64::MAX);
        let odd = |python: &mut MersenneTwister, cells: usize| 2 * python.randbelow(cells as u32) as usize + 1;
        let cell = |python: &mut MersenneTwister| Place { row: odd(python, rows), column: odd(python, columns) };
        let mut at = cell(&mut python);
        self.open(at);
        self.walk(at, &mut python, &mut numpy);
        for _ in 0..self.walls.len() * self.columns {
            at = cell(&mut python);
            if !self.is_wall(at) {
                self.walk(at, &mut python, &mut numpy);
            }
        }
        let side = python.randbelow(4);
        let cells = if side < 2 { columns } else { rows };
        let (start, goal) = (odd(&mut python, cells), odd(&mut python, cells));
        (self.start, self.goal) = match side {
            0 => (Place { row: 0, column: start }, Place { row: 2 * rows, column: goal }),
            1 => (Place { row: 2 * rows, column: start }, Place { row: 0, column: goal }),
            2 => (Place { row: start, column: 0 }, Place { row: goal, column: 2 * columns }),
            _ => (Place { row: start, column: 2 * columns }, Place { row: goal, column: 0 }),
        };
        self.random = Some((python, numpy));
    }

    /// Walks at random from a cell, and opens passages to unvisited cells until there is none around.
    fn walk(&mut self, mut at: Place, python: &mut MersenneTwister, numpy: &mut MersenneTwister) {
        loop {
            let mut around = [at; 4];
            let mut count = 0;
            let Place { row, column } = at;
            let up = row.checked_sub(2).map(|row| Place { row, column });
            let left = column.checked_sub(2).map(|column| Place { row, column });
            let candidates = [up, Some(Place { row: row + 2, column }), left, Some(Place { row, column: column + 2 })];
            for place in candidates.into_iter().flatten() {
                if place.row < self.walls.len() && place.column < self.columns && self.is_wall(place) {
                    around[count] = place;
                    count += 1;
                }
            }
            let around = &mut around[..count];
            numpy.shuffle(around);
            let Some(next) = around.get(python.randbelow(count as u32) as usize).copied() else { return };
            self.open(next);
            self.open(Place { row: (row + next.row) / 2, column: (column + next.column) / 2 });
            at = next;
        }
    }

    fn open(&mut self, place: Place) {
        self.walls[place.row] &= !(1 << place.column);
    }

    /// Rows and columns.
    pub fn size(&self) -> [usize; 2] {
        [self.walls.len(), self.columns]
    }

    /// Whether a square inside the maze is a wall.
    pub fn is_wall(&self, place: Place) -> bool {
        self.walls[place.row] >> place.column & 1 == 1
    }

    /// Number of squares that are no walls.
    pub fn free(&self) -> u32 {
        self.walls.iter().map(|row| row.count_zeros()).sum()
    }

    /// The squares that are no walls, as bits of rows.
    pub fn ways(&self) -> Vec<u64> {
        self.walls.iter().map(|row| !row).collect()
    }

    /// Whether a restored maze has at most so many rows and columns of cells, exactly one way between any two of them, and start and exit
    /// at opposite sides.
    pub fn is_valid(&self, [rows, columns]: [usize; 2]) -> bool {
        let (ways, Maze { start, goal, .. }) = (self.ways(), self);
        let (last_row, last_column) = (2 * rows, 2 * columns);
        let odd = (0..columns).fold(0, |columns, cell| columns | 2 << (2 * cell));
        let inside = (1 << last_column) - 2;
        let is_open = |(row, ways): (usize, &u64)| ways & !(if row % 2 == 1 { inside } else { odd }) == 0;
        let open: u32 = ways.iter().skip(1).step_by(2).map(|row| (row & odd).count_ones()).sum();
        let Some(row) = ways.iter().position(|ways| *ways != 0) else { return false };
        let first = Place { row, column: ways[row].trailing_zeros() as usize };
        let are_odd = |a: usize, b: usize, last| a % 2 == 1 && b % 2 == 1 && a.max(b) < last;
        let are_ends = |a: usize, b: usize, last| a.min(b) == 0 && a.max(b) == last;
        self.size() == [last_row + 1, last_column + 1]
            && ways[0] | ways[last_row] == 0
            && ways.iter().enumerate().all(is_open)
            && self.free() + 1 == 2 * open
            && connected(&ways, first) == ways
            && (are_ends(start.row, goal.row, last_row) && are_odd(start.column, goal.column, last_column)
                || are_ends(start.column, goal.column, last_column) && are_odd(start.row, goal.row, last_row))
            && self.random.as_ref().is_some_and(|(python, numpy)| python.is_valid() && numpy.is_valid())
    }
}

/// Those of the squares, as bits of rows, to which a way over them leads from one of them.
pub fn connected(squares: &[u64], from: Place) -> Vec<u64> {
    let mut reached = vec![0; squares.len()];
    reached[from.row] = squares[from.row] & 1 << from.column;
    loop {
        let row = |row: usize| reached.get(row).copied().unwrap_or(0);
        let around = |at: usize| row(at) | row(at) << 1 | row(at) >> 1 | row(at.wrapping_sub(1)) | row(at + 1);
        let next: Vec<u64> = squares.iter().enumerate().map(|(at, squares)| squares & around(at)).collect();
        if next == reached {
            return reached;
        }
        reached = next;
    }
}
