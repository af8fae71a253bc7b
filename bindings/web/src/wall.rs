//! Many environments as one picture.

use endless_gym_core::raster::FrameShape;
use serde_json::{Value as Json, json};

use crate::error::WebError;
use crate::group::Group;
use crate::pixels::put_observation;

/// Transparent pixels between two environments.
const GAP: usize = 4;

pub struct Wall {
    groups: Vec<Group>,
    columns: usize,
    rows: usize,
    /// Width and height of the largest frame.
    cell: (usize, usize),
    picture: Vec<u8>,
}

impl Wall {
    /// Environments in rows of `columns`, those of the first group first.
    pub fn new(groups: Vec<Group>, columns: usize) -> Result<Self, WebError> {
        let count = groups.iter().map(|group| group.observations().count()).sum::<usize>();
        if count == 0 || columns == 0 {
            return Err(WebError::EmptyWall);
        }
        let shapes = || groups.iter().map(Group::shape);
        let largest = |side: fn(FrameShape) -> usize| shapes().map(side).max().unwrap_or(0);
        let cell = (largest(|shape| shape.width), largest(|shape| shape.height));
        let mut wall = Wall { groups, columns, rows: count.div_ceil(columns), cell, picture: Vec::new() };
        wall.picture = vec![0; wall.width() * wall.height() * 4];
        Ok(wall)
    }

    fn width(&self) -> usize {
        self.columns * (self.cell.0 + GAP) - GAP
    }

    fn height(&self) -> usize {
        self.rows * (self.cell.1 + GAP) - GAP
    }

    pub fn step(&mut self, count: u32) -> Result<(), WebError> {
        (0..count).try_for_each(|_| self.groups.iter_mut().try_for_each(Group::step))?;
        self.groups.iter_mut().try_for_each(Group::draw)
    }

    /// The episode that the environment at a place of the picture plays.
    pub fn episode(&self, mut place: usize) -> Result<Json, WebError> {
        for group in &self.groups {
            let count = group.observations().count();
            if place < count {
                return group.episode(place);
            }
            place -= count;
        }
        Err(WebError::NoTile)
    }

    /// The picture, RGBA.
    pub fn draw(&mut self) -> &[u8] {
        let stride = self.width();
        for (number, (observation, shape)) in self.groups.iter().flat_map(Group::observations).enumerate() {
            let (row, column) = (number / self.columns, number % self.columns);
            let start = row * (self.cell.1 + GAP) * stride + column * (self.cell.0 + GAP);
            put_observation(observation, shape, &mut self.picture[4 * start..], stride);
        }
        &self.picture
    }

    pub fn state(&self) -> Json {
        let groups: Vec<Json> = self.groups.iter().map(Group::state).collect();
        json!({"width": self.width(), "height": self.height(), "columns": self.columns, "groups": groups})
    }
}
