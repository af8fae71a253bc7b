//! The character that every agent steers: its pictures and its ways of moving.
//!
//! Source: the original's `character_controller.py`.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::vector::rotate;
use crate::raster::{Canvas, Rect, Rgb, Sprite, Surface};

const BODY: Rgb = [250, 204, 153];
const HANDS: Rgb = [250, 250, 250];
const HAND_OUTLINES: Rgb = [50, 50, 50];
/// The colour that is not drawn: what pygame makes of the number 255.
const TRANSPARENT: Rgb = [0, 0, 255];
/// Pixels that a picture is wider than body and hands.
const MARGIN: i32 = 14;

/// The character's eight pictures, one for each 45 degrees, at one scale.
#[derive(PartialEq, Eq)]
pub struct CharacterSprites {
    radius: i32,
    size: i32,
    /// By rotation, counterclockwise from up.
    sprites: [Sprite; 8],
}

impl CharacterSprites {
    /// Draws the pictures at `scale`; 0.25 is the original's default.
    pub fn new(scale: f64) -> Self {
        let pixels = |length: f64| (length * scale) as i32;
        let (radius, hand_radius) = (pixels(25.0), pixels(10.0));
        let size = radius * 2 + hand_radius + MARGIN;
        let centre = size / 2;
        let hand_y = pixels(12.0) + MARGIN / 2 - centre;
        let hands = [-pixels(18.0), pixels(18.0)].map(|x| [f64::from(x), f64::from(hand_y)]);
        let sprites = std::array::from_fn(|eighth| {
            let mut surface = Surface::new(size as usize, size as usize);
            surface.fill(TRANSPARENT);
            surface.set_color_key(Some(TRANSPARENT));
            surface.draw_circle(BODY, (centre, centre), radius, 0);
            let degrees = 360.0 - 45.0 * eighth as f64;
            let hands = hands.map(|hand| {
                let [x, y] = rotate(hand, degrees);
                ((x + f64::from(centre)) as i32, (y + f64::from(centre)) as i32)
            });
            hands.iter().for_each(|hand| surface.draw_circle(HANDS, *hand, hand_radius, 0));
            hands.iter().for_each(|hand| surface.draw_circle(HAND_OUTLINES, *hand, hand_radius, pixels(3.0)));
            Sprite::new(&surface)
        });
        CharacterSprites { radius, size, sprites }
    }

    /// The pictures as they look under a black surface of some `alpha`.
    pub fn shaded(&self, alpha: u8) -> Self {
        CharacterSprites { sprites: self.sprites.each_ref().map(|sprite| sprite.shaded(alpha)), ..*self }
    }

    /// Radius of the body in pixels.
    pub fn radius(&self) -> i32 {
        self.radius
    }

    /// Pixels from a picture's left and top edges to the character's centre.
    pub fn centre(&self) -> i32 {
        self.size / 2
    }

    /// The character's picture, and the place of its top left corner on the screen.
    pub fn picture(&self, character: &Character) -> (&Sprite, (i32, i32)) {
        let (x, y) = character.position;
        let corner = self.centre();
        (&self.sprites[character.rotation as usize / 45 % self.sprites.len()], (x - corner, y - corner))
    }

    /// The smallest rectangle about the character.
    pub fn bounds(&self, character: &Character) -> Rect {
        let (sprite, corner) = self.picture(character);
        sprite.bounds_at(corner)
    }

    /// Draws the character.
    pub fn draw(&self, character: &Character, canvas: &mut Canvas<'_>) {
        let (sprite, (x, y)) = self.picture(character);
        sprite.blit(canvas, x, y);
    }
}

impl fmt::Debug for CharacterSprites {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("CharacterSprites").field("radius", &self.radius).finish_non_exhaustive()
    }
}

/// Where the character is and where it faces.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Character {
    /// Centre in pixels of the screen.
    pub position: (i32, i32),
    /// Degrees counterclockwise from up, a multiple of 45 in 0..360.
    pub rotation: i32,
}

/// A rectangle that holds the character: left, top, right, bottom in pixels, the last two just outside.
pub type Bounds = (i32, i32, i32, i32);

impl Character {
    /// Whether the character can be at such a place and face in such a direction.
    pub fn is_valid(&self) -> bool {
        const FAR: i32 = 1 << 28;
        let near = |at: i32| (-FAR..=FAR).contains(&at);
        (0..360).contains(&self.rotation) && self.rotation % 45 == 0 && near(self.position.0) && near(self.position.1)
    }

    /// Turns to where the action points, and returns the unit vector of the movement.
    fn turn(&mut self, action: &[i32]) -> [f64; 2] {
        let towards = |branch: i32| [0.0, -1.0, 1.0][branch as usize];
        let (x, y): (f64, f64) = (towards(action[0]), towards(action[1]));
        self.rotation = match (action[0], action[1]) {
            (0, 1) => 0,
            (1, 1) => 45,
            (1, 0) => 90,
            (1, 2) => 135,
            (0, 2) => 180,
            (2, 2) => 225,
            (2, 0) => 270,
            (2, 1) => 315,
            _ => return [0.0, 0.0],
        };
        let length = (x * x + y * y).sqrt();
        [x / length, y / length]
    }

    /// Moves by `speed` pixels, cut to whole pixels for each axis, and returns by how much.
    pub fn step(&mut self, action: &[i32], speed: f64) -> (i32, i32) {
        let [x, y] = self.turn(action).map(|part| (part * speed) as i32);
        self.position = (self.position.0 + x, self.position.1 + y);
        (x, y)
    }

    /// Moves by `speed` pixels, cut to whole pixels for each axis, and stays within `bounds` by its radius.
    pub fn step_within(&mut self, action: &[i32], speed: f64, radius: i32, bounds: Bounds) {
        self.step(action, speed);
        let (left, top, right, bottom) = bounds;
        // The far side first, so that the near side wins where the character does not fit.
        let hold = |at: i32, low: i32, high: i32| at.min(high - radius).max(low + radius);
        self.position = (hold(self.position.0, left, right), hold(self.position.1, top, bottom));
    }

    /// Moves by `speed` pixels, rounded to whole pixels after the sum, and comes back on the other side when more than half of
    /// it has left `bounds`.
    pub fn step_wrapping(&mut self, action: &[i32], speed: f64, radius: i32, bounds: Bounds) {
        let [x, y] = self.turn(action);
        let (left, top, right, bottom) = bounds;
        let half = f64::from(radius) * 0.5;
        let wrap = |at: f64, low: i32, high: i32| {
            let (low, high) = (f64::from(low) - half, f64::from(high) + half);
            // Both in turn, each on what the other left behind; rounded half away from zero, as a pygame Rect does.
            let at = at.round();
            let at = if at > high { low } else { at };
            if at < low { high } else { at }.round() as i32
        };
        self.position = (
            wrap(f64::from(self.position.0) + x * speed, left, right),
            wrap(f64::from(self.position.1) + y * speed, top, bottom),
        );
    }

    /// Turns left (1), right (2) or walks one cell ahead (3) on a grid of `size` x `size` cells; 0 does nothing.
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
