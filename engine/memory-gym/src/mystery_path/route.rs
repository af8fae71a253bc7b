//! The route of an episode: one generated path, or a growing row of joined paths.
//!
//! Source: `EndlessMysteryPath` of the original's `pygame_assets.py`, and the visits that its nodes record.

use serde::{Deserialize, Serialize};

use super::path::{GRID, Path, Tile, TileSet};
use endless_gym_core::random::Generator;

/// Columns of a segment of the endless route: a grid, and a column with the one tile that leads to the next grid.
pub const SEGMENT: i32 = GRID + 1;

/// One path and its visited tiles.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Segment {
    tiles: TileSet,
    walls: TileSet,
    /// Index of the first tile in the whole route.
    first: usize,
    /// Tiles that the agent has visited in the episode. The route's first tile always counts as visited.
    seen: TileSet,
    /// Tiles that the agent has visited since its last fall. The route's first tile always counts as visited.
    seen_since_fall: TileSet,
}

/// The tiles of the route, and which of them the agent has visited.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Route {
    segments: Vec<Segment>,
    /// All tiles in order.
    tiles: Vec<Tile>,
}

/// The result of a visit to a tile of the route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Visit {
    /// Whether it is the first visit in the episode.
    pub first: bool,
    /// Whether it is the first visit since the last fall.
    pub first_since_fall: bool,
}

impl Route {
    /// Whether there can be such a route. A forged snapshot may hold any numbers.
    pub fn is_valid(&self) -> bool {
        let ends = self.segments.iter().skip(1).map(|segment| segment.first).chain([self.tiles.len()]);
        let lefts = (0..).step_by(SEGMENT as usize);
        self.segments.len() < 1 << 24
            && self.segments.first().is_some_and(|segment| segment.first == 0)
            && self.segments.iter().zip(ends).zip(lefts).all(|((segment, end), left)| {
                let tiles = self.tiles.get(segment.first..end).unwrap_or_default();
                let mut set = TileSet::default();
                tiles.iter().for_each(|(x, y)| set.insert((x.wrapping_sub(left), *y)));
                !tiles.is_empty()
                    && (set.count(), set) == (tiles.len(), segment.tiles)
                    && segment.walls.is_subset(TileSet::GRID)
                    && segment.seen.is_subset(set)
                    && segment.seen_since_fall.is_subset(segment.seen)
            })
            && self.tiles.windows(2).all(|pair| pair[0].0.abs_diff(pair[1].0) + pair[0].1.abs_diff(pair[1].1) == 1)
    }

    /// Whether a tile is part of it.
    pub fn contains(&self, (x, y): Tile) -> bool {
        let segment = usize::try_from(x / SEGMENT).ok().and_then(|number| self.segments.get(number));
        segment.is_some_and(|segment| segment.tiles.contains((x % SEGMENT, y)))
    }

    /// Removes all paths but keeps the allocated memory.
    pub fn clear(&mut self) {
        self.segments.clear();
        self.tiles.clear();
    }

    /// Replaces the route with one path from `start` to `end`.
    pub fn set_path(&mut self, start: Tile, end: Tile, random: &mut Generator) {
        self.clear();
        self.add(Path::generate(start, end, random), None);
    }

    /// Adds a path from left to right that starts in the row where the last one ended; the first one starts in a random row.
    pub fn extend(&mut self, random: &mut Generator) {
        let mut row = || random.integers(0, i64::from(GRID)) as i32;
        let start = self.tiles.last().map_or_else(&mut row, |(_, y)| *y);
        let end = row();
        self.add(Path::generate((0, start), (GRID - 1, end), random), Some((GRID, end)));
    }

    fn add(&mut self, path: Path, joint: Option<Tile>) {
        let left = self.segments.len() as i32 * SEGMENT;
        let mut segment = Segment {
            tiles: TileSet::default(),
            walls: path.walls,
            first: self.tiles.len(),
            seen: TileSet::default(),
            seen_since_fall: TileSet::default(),
        };
        for (x, y) in path.tiles().chain(joint) {
            segment.tiles.insert((x, y));
            self.tiles.push((left + x, y));
        }
        self.segments.push(segment);
        if left == 0 {
            self.mark_start();
        }
    }

    fn mark_start(&mut self) {
        if let (Some(segment), Some(start)) = (self.segments.first_mut(), self.tiles.first()) {
            segment.seen.insert(*start);
            segment.seen_since_fall.insert(*start);
        }
    }

    /// Number of joined paths.
    pub fn segments(&self) -> usize {
        self.segments.len()
    }

    /// The tiles in order.
    pub fn tiles(&self) -> &[Tile] {
        &self.tiles
    }

    /// The first tile.
    pub fn start(&self) -> Tile {
        self.tiles.first().copied().unwrap_or_default()
    }

    /// The last tile.
    pub fn end(&self) -> Tile {
        self.tiles.last().copied().unwrap_or_default()
    }

    /// Walls of the first path.
    pub fn walls(&self) -> impl Iterator<Item = Tile> {
        self.segments.first().into_iter().flat_map(|segment| segment.walls.iter())
    }

    /// Visits a tile. Returns `None` if it is not on the route.
    pub fn visit(&mut self, (x, y): Tile) -> Option<Visit> {
        let segment = self.segments.get_mut(usize::try_from(x / SEGMENT).ok()?)?;
        let tile = (x % SEGMENT, y);
        if !segment.tiles.contains(tile) {
            return None;
        }
        let visit =
            Visit { first: !segment.seen.contains(tile), first_since_fall: !segment.seen_since_fall.contains(tile) };
        segment.seen.insert(tile);
        segment.seen_since_fall.insert(tile);
        Some(visit)
    }

    /// Records a fall: no tile except the first has been visited since.
    pub fn fall(&mut self) {
        self.segments.iter_mut().for_each(|segment| segment.seen_since_fall = TileSet::default());
        self.mark_start();
    }

    /// The index of a tile in the route; `None` if it is not on the route.
    pub fn index(&self, tile: Tile) -> Option<usize> {
        let first = self.segments.get(usize::try_from(tile.0 / SEGMENT).ok()?)?.first;
        self.tiles[first..].iter().position(|other| *other == tile).map(|place| first + place)
    }
}
