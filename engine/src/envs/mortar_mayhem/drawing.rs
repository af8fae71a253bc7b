//! How Mortar Mayhem looks: the pictures made once for each set of reset parameters, and how a frame is put together.

use std::sync::Arc;

use super::commands::{COMMANDS, Command, PICTURE_SIZE, pictures};
use super::parameters::{Parameters, Variant};
use super::rules::MortarMayhem;
use crate::envs::character::{Bounds, CharacterSprites};
use crate::envs::{FRAME_BYTES, SCREEN};
use crate::raster::{Canvas, Rect, Rgb, Sprite, Surface};

/// Side of a tile in pixels.
pub const TILE: i32 = 14;
const TILE_BORDER: i32 = 1;

/// The ring that marks the target in the ground-truth view.
const TARGET: Rgb = [0, 255, 0];
const TARGET_WIDTH: i32 = 2;

/// Colours of a tile and of its border.
type TileColours = (Rgb, Rgb);
const CALM: TileColours = ([21, 43, 77], [29, 60, 107]);
const BURNING: TileColours = ([81, 18, 26], [112, 24, 36]);

/// What all environments with the same reset parameters share.
#[derive(Debug)]
pub struct Assets {
    pub variant: Variant,
    pub parameters: Parameters,
    pub character: Arc<CharacterSprites>,
    /// Where the arena lies on the screen.
    pub arena: Bounds,
    /// Frames that show the arena alone: all tiles calm, all tiles burning.
    calm: Vec<u8>,
    burning: Vec<u8>,
    commands: [Sprite; COMMANDS],
}

impl Assets {
    /// Makes the pictures.
    pub fn new(variant: Variant, parameters: Parameters) -> Self {
        let side = parameters.arena_size * TILE;
        let corner = (SCREEN as i32 - side) / 2;
        let arena = |(fill, border): TileColours| {
            let mut tile = Surface::new(TILE as usize, TILE as usize);
            tile.fill(fill);
            tile.draw_rect(border, Rect { x: 0, y: 0, width: TILE, height: TILE }, TILE_BORDER);
            let mut screen = Surface::new(SCREEN, SCREEN);
            for x in 0..parameters.arena_size {
                for y in 0..parameters.arena_size {
                    screen.blit(&tile, corner + x * TILE, corner + y * TILE);
                }
            }
            screen.into_pixels()
        };
        Assets {
            variant,
            character: Arc::new(CharacterSprites::new(parameters.agent_scale)),
            arena: (corner, corner, corner + side, corner + side),
            calm: arena(CALM),
            burning: arena(BURNING),
            commands: pictures(),
            parameters,
        }
    }
}

impl MortarMayhem {
    pub(super) fn draw_frame(&self, frame: &mut [u8]) {
        let frame = &mut frame[..FRAME_BYTES];
        self.draw_arena(frame);
        let (sprites, character) = self.shown_character();
        let mut canvas = Canvas::new(frame, SCREEN, SCREEN);
        sprites.draw(character, &mut canvas);
        if let Some(command) = self.state.shown_command {
            self.assets.draw_command(command, &mut canvas);
        }
    }

    /// The original's `_build_debug_surface`: the target is marked, and the clue goes on by one frame each time.
    pub(super) fn draw_debug_frame(&mut self, canvas: &mut Canvas<'_>) {
        self.draw_arena(canvas.pixels_mut());
        let (sprites, character) = self.last_moved();
        sprites.draw(character, canvas);
        if !self.state.clue.is_over()
            && let Some(number) = self.state.viewed_clue.next_frame()
            && let Some(command) = self.state.commands.get(number)
        {
            self.assets.draw_command(*command, canvas);
        }
        let centre = |corner: i32, tile: i32| corner + tile * TILE + TILE / 2;
        let (x, y) = self.state.target;
        let target = (centre(self.assets.arena.0, x), centre(self.assets.arena.1, y));
        canvas.draw_circle(TARGET, target, TILE / 2, TARGET_WIDTH);
    }

    fn draw_arena(&self, frame: &mut [u8]) {
        match self.visible_fire() {
            None => frame.copy_from_slice(&self.assets.calm),
            Some((x, y)) => {
                frame.copy_from_slice(&self.assets.burning);
                self.assets.extinguish(frame, x, y);
            }
        }
    }
}

impl Assets {
    fn draw_command(&self, command: Command, canvas: &mut Canvas<'_>) {
        let corner = (SCREEN as i32 - PICTURE_SIZE) / 2;
        self.commands[command.index()].blit(canvas, corner, corner);
    }

    /// Gives one tile of a burning arena its calm colours back.
    fn extinguish(&self, frame: &mut [u8], x: i32, y: i32) {
        let top = self.arena.1 + y * TILE;
        for column in 0..TILE {
            let left = self.arena.0 + x * TILE + column;
            let start = (left as usize * SCREEN + top as usize) * 3;
            let bytes = start..start + TILE as usize * 3;
            frame[bytes.clone()].copy_from_slice(&self.calm[bytes]);
        }
    }
}
