//! The chessboard that some families paint behind everything.
//!
//! Source: `get_tiled_background_surface` of the original's `pygame_assets.py`.

use super::SCREEN;
use crate::raster::{Rect, Rgb, Surface};

/// Side of a tile in pixels: 50 on the original's screen of 336 pixels, cut to whole pixels on this one.
pub const BACKGROUND_TILE: usize = 12;

const WHITE: Rgb = [255, 255, 255];

/// A screen of tiles that are white and of `tile_color` by turns, white in the top left corner.
pub fn tiled_background(tile_color: Rgb) -> Surface {
    let mut surface = Surface::new(SCREEN, SCREEN);
    let tiles = SCREEN.div_ceil(BACKGROUND_TILE);
    let side = BACKGROUND_TILE as i32;
    for (column, row) in (0..tiles).flat_map(|column| (0..tiles).map(move |row| (column, row))) {
        let color = if (column + row) % 2 == 0 { WHITE } else { tile_color };
        surface.draw_rect(color, Rect::new(column as i32 * side, row as i32 * side, side, side), 0);
    }
    surface
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_alternate_and_the_corner_is_white() {
        let surface = tiled_background([1, 2, 3]);
        assert_eq!(surface.pixel(0, 0), Some(WHITE));
        assert_eq!(surface.pixel(11, 11), Some(WHITE));
        assert_eq!(surface.pixel(12, 11), Some([1, 2, 3]));
        assert_eq!(surface.pixel(12, 12), Some(WHITE));
        assert_eq!(surface.pixel(83, 0), Some(WHITE));
        assert_eq!(surface.pixel(83, 71), Some([1, 2, 3]));
    }
}
