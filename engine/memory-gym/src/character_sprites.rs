//! The pictures of the character.
//!
//! Source: the original's `character_controller.py`.

use std::fmt;

use super::character::{Character, CharacterSize, MARGIN};
use super::vector::rotate;
use endless_gym_core::raster::{Canvas, Rect, Rgb, Sprite, Surface};

const BODY: Rgb = [250, 204, 153];
const HANDS: Rgb = [250, 250, 250];
const HAND_OUTLINES: Rgb = [50, 50, 50];
/// The transparent colour: pygame's conversion of the number 255.
const TRANSPARENT: Rgb = [0, 0, 255];

/// The character's eight pictures at one scale, one for each 45 degrees.
#[derive(PartialEq, Eq)]
pub struct CharacterSprites {
    size: CharacterSize,
    /// By rotation, counterclockwise from up.
    sprites: [Sprite; 8],
}

impl CharacterSprites {
    /// Draws the pictures at `scale`, at least 0; 0.25 is the original's default.
    pub fn new(scale: f64) -> Self {
        let pixels = |length: f64| (length * scale) as i32;
        let size = CharacterSize::new(scale);
        let (side, centre) = (size.side(), size.centre());
        let hand_y = pixels(12.0) + MARGIN / 2 - centre;
        let hands = [-pixels(18.0), pixels(18.0)].map(|x| [f64::from(x), f64::from(hand_y)]);
        let sprites = std::array::from_fn(|eighth| {
            let mut surface = Surface::new(side as usize, side as usize);
            surface.fill(TRANSPARENT);
            surface.set_color_key(Some(TRANSPARENT));
            surface.draw_circle(BODY, (centre, centre), size.radius, 0);
            let degrees = 360.0 - 45.0 * eighth as f64;
            let hands = hands.map(|hand| {
                let [x, y] = rotate(hand, degrees);
                ((x + f64::from(centre)) as i32, (y + f64::from(centre)) as i32)
            });
            hands.iter().for_each(|hand| surface.draw_circle(HANDS, *hand, size.hand_radius, 0));
            hands.iter().for_each(|hand| surface.draw_circle(HAND_OUTLINES, *hand, size.hand_radius, pixels(3.0)));
            Sprite::new(&surface)
        });
        CharacterSprites { size, sprites }
    }

    /// The pictures as seen through a black surface with the given `alpha`.
    pub fn shaded(&self, alpha: u8) -> Self {
        CharacterSprites { sprites: self.sprites.each_ref().map(|sprite| sprite.shaded(alpha)), ..*self }
    }

    /// The picture of the character, and the position of the picture's top left corner on the screen.
    pub fn picture(&self, character: &Character) -> (&Sprite, (i32, i32)) {
        let (x, y) = character.position;
        let corner = self.size.centre();
        (&self.sprites[character.rotation as usize / 45 % self.sprites.len()], (x - corner, y - corner))
    }

    /// The smallest rectangle around the character's visible pixels.
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
        formatter.debug_struct("CharacterSprites").field("size", &self.size).finish_non_exhaustive()
    }
}
