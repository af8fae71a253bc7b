//! The pictures of the commands.

use super::commands::{COMMANDS, Command};
use crate::raster::{Rgb, Sprite, Surface};

/// Scale of the command pictures relative to the original's 336 pixel screen.
const SCALE: f64 = 0.25;
const WHITE: Rgb = [255, 255, 255];
const BLACK: Rgb = [0, 0, 0];

/// Side of an unrotated command picture in pixels.
pub const COMMAND_SIDE: i32 = (88.0 * SCALE) as i32;

/// The pictures of all commands, by number.
pub fn command_sprites() -> [Sprite; COMMANDS] {
    let pixels = |length: f64| (length * SCALE) as i32;
    std::array::from_fn(|index| {
        let mut surface = Surface::new(COMMAND_SIDE as usize, COMMAND_SIDE as usize);
        surface.fill(BLACK);
        surface.set_color_key(Some(BLACK));
        let width = pixels(8.0);
        match Command::from_index(index).angle() {
            None => {
                let radius = COMMAND_SIDE / 2 - pixels(4.0);
                let (x, y) = (COMMAND_SIDE - pixels(12.0), COMMAND_SIDE / 2 - pixels(8.0));
                surface.draw_circle(WHITE, (radius, radius), radius, width);
                surface.draw_line(WHITE, (0, y), (x, y), width);
            }
            Some(angle) => {
                let (tail, tip, middle) = (pixels(2.0), pixels(80.0), pixels(40.0));
                surface.draw_line(WHITE, (tail, middle), (tip, middle), width);
                surface.draw_line(WHITE, (tip, middle), (middle, 0), width);
                surface.draw_line(WHITE, (tip, middle), (middle, tip), width);
                surface = surface.rotate(angle);
            }
        }
        Sprite::new(&surface)
    })
}
