//! The character that every agent controls: its dimensions and how it moves.
//!
//! Source: the original's `character_controller.py`.

use std::f64::consts::SQRT_2;

use serde::{Deserialize, Serialize};

/// Pixels by which a picture is wider than the body's diameter plus a hand's radius.
pub(super) const MARGIN: i32 = 14;

/// Dimensions of the character at one scale, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CharacterSize {
    /// Radius of the body.
    pub radius: i32,
    /// Radius of a hand.
    pub hand_radius: i32,
}

impl CharacterSize {
    /// The dimensions at `scale`, at least 0; 0.25 is the original's default. Lengths are truncated to whole pixels.
    pub fn new(scale: f64) -> Self {
        CharacterSize { radius: (25.0 * scale) as i32, hand_radius: (10.0 * scale) as i32 }
    }

    /// Side of the square picture, with body, hands and margin.
    pub fn side(&self) -> i32 {
        self.radius * 2 + self.hand_radius + MARGIN
    }

    /// Distance from the picture's left and top edges to the character's centre.
    pub fn centre(&self) -> i32 {
        self.side() / 2
    }
}

/// Position and direction of the character.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Character {
    /// Centre in pixels.
    pub position: (i32, i32),
    /// Degrees counterclockwise from up, a multiple of 45 in 0..360.
    pub rotation: i32,
}

/// The rectangle that the character must stay in: left, top, right, bottom in pixels, right and bottom exclusive.
pub type Bounds = (i32, i32, i32, i32);

impl Character {
    /// Whether position and direction are in their ranges. A forged snapshot may hold any numbers.
    pub fn is_valid(&self) -> bool {
        const FAR: i32 = 1 << 28;
        let near = |at: i32| (-FAR..=FAR).contains(&at);
        (0..360).contains(&self.rotation) && self.rotation % 45 == 0 && near(self.position.0) && near(self.position.1)
    }

    /// Turns in the direction of the action and returns it as a unit vector; no movement returns (0, 0) and turns nothing.
    /// Branchless, since random actions are unpredictable.
    fn turn(&mut self, action: &[i32]) -> [f64; 2] {
        const TOWARDS: [f64; 3] = [0.0, -1.0, 1.0];
        // Indexed by the branches of the action. The first is not used.
        const ROTATIONS: [[i32; 3]; 3] = [[0, 0, 180], [90, 45, 135], [270, 315, 225]];
        let (x, y) = (action[0] as usize, action[1] as usize);
        let rotation = ROTATIONS[x][y];
        self.rotation = if x + y == 0 { self.rotation } else { rotation };
        let length = [1.0, SQRT_2][usize::from(x * y != 0)];
        [TOWARDS[x] / length, TOWARDS[y] / length]
    }

    /// Moves by `speed` pixels, truncated to whole pixels on each axis, and returns the movement.
    pub fn step(&mut self, action: &[i32], speed: f64) -> (i32, i32) {
        let [x, y] = self.turn(action).map(|part| (part * speed) as i32);
        self.position = (self.position.0 + x, self.position.1 + y);
        (x, y)
    }

    /// Moves by `speed` pixels, truncated to whole pixels on each axis, and keeps `radius` pixels away from the edges of
    /// `bounds`. If `bounds` is too small for that, the left and top edges take precedence.
    pub fn step_within(&mut self, action: &[i32], speed: f64, radius: i32, bounds: Bounds) {
        self.step(action, speed);
        let (left, top, right, bottom) = bounds;
        // The far side first, so that the near side takes precedence.
        let clamp_axis = |at: i32, low: i32, high: i32| at.min(high - radius).max(low + radius);
        self.position = (clamp_axis(self.position.0, left, right), clamp_axis(self.position.1, top, bottom));
    }

    /// Moves by `speed` pixels, with the new position rounded to whole pixels, and wraps around to the opposite side
    /// when more than half of the character has left `bounds`.
    pub fn step_wrapping(&mut self, action: &[i32], speed: f64, radius: i32, bounds: Bounds) {
        let [x, y] = self.turn(action);
        let (left, top, right, bottom) = bounds;
        let half = f64::from(radius) * 0.5;
        let wrap = |at: f64, low: i32, high: i32| {
            let (low, high) = (f64::from(low) - half, f64::from(high) + half);
            // The second check applies to the result of the first. Rounds half away from zero, like a pygame Rect.
            let at = at.round();
            let at = if at > high { low } else { at };
            if at < low { high } else { at }.round() as i32
        };
        self.position = (
            wrap(f64::from(self.position.0) + x * speed, left, right),
            wrap(f64::from(self.position.1) + y * speed, top, bottom),
        );
    }

    /// Turns left (1), turns right (2) or walks one cell ahead (3) on a grid of `size` x `size` cells; 0 does nothing.
    /// Returns the new cell; the caller must set the position.
    pub fn step_on_grid(&mut self, action: i32, cell: (i32, i32), size: i32) -> (i32, i32) {
        let (mut x, mut y) = cell;
        match (action, self.rotation) {
            (1, rotation) => self.rotation = (rotation + 90) % 360,
            (2, rotation) => self.rotation = (rotation + 270) % 360,
            (3, 0) => y = (y - 1).max(0),
            (3, 90) => x = (x - 1).max(0),
            (3, 180) => y = (y + 1).min(size - 1),
            (3, _) => x = (x + 1).min(size - 1),
            _ => {}
        }
        (x, y)
    }

    /// Unit vector of the direction that the character faces.
    pub fn heading(&self) -> [f32; 2] {
        let diagonal = std::f32::consts::FRAC_1_SQRT_2;
        match self.rotation {
            0 => [0.0, -1.0],
            45 => [-diagonal, -diagonal],
            90 => [-1.0, 0.0],
            135 => [-diagonal, diagonal],
            180 => [0.0, 1.0],
            225 => [diagonal, diagonal],
            270 => [1.0, 0.0],
            _ => [diagonal, -diagonal],
        }
    }
}
