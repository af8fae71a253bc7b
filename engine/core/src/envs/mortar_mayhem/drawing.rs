//! How Mortar Mayhem looks: the pictures made once for each set of reset parameters, and how a frame is put together.

use std::sync::Arc;

use super::commands::{COMMANDS, Command, PICTURE_SIZE, pictures};
use super::parameters::{Parameters, Variant};
use super::rules::MortarMayhem;
use crate::envs::SCREEN;
use crate::envs::character::{Bounds, Character, CharacterSprites};
use crate::raster::{Canvas, Damage, Rect, Rgb, Sprite, Surface};

/// Side of a tile in pixels.
pub const TILE: i32 = 14;
const TILE_BORDER: i32 = 1;

/// Top left corner of the command pictures.
const COMMAND_CORNER: (i32, i32) = ((SCREEN as i32 - PICTURE_SIZE) / 2, (SCREEN as i32 - PICTURE_SIZE) / 2);

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

/// What a frame shows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Scene {
    /// The one tile that does not burn, while the others do.
    spared: Option<(i32, i32)>,
    character: Character,
    /// The character's pictures, where they are those of an earlier episode.
    former_sprites: Option<Arc<CharacterSprites>>,
    command: Option<Command>,
}

impl Scene {
    /// Paints the frame.
    pub(super) fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        assets.paint_arena(self.spared, canvas);
        self.sprites(assets).draw(&self.character, canvas);
        if let Some(command) = self.command {
            assets.draw_command(command, canvas);
        }
    }

    /// Where a frame that shows `shown` differs.
    pub(super) fn damage_since(&self, shown: &Scene, assets: &Assets) -> Damage {
        let mut damage = Damage::new(SCREEN, SCREEN);
        if self.spared != shown.spared {
            let (left, top, right, bottom) = assets.arena;
            damage.add(Rect::new(left, top, right - left, bottom - top));
        }
        if self.command != shown.command {
            let bounds = |command: Command| assets.commands[command.index()].bounds_at(COMMAND_CORNER);
            [shown.command, self.command].into_iter().flatten().for_each(|command| damage.add(bounds(command)));
        }
        if (&self.character, &self.former_sprites) != (&shown.character, &shown.former_sprites) {
            [shown, self].iter().for_each(|scene| damage.add(scene.sprites(assets).bounds(&scene.character)));
        }
        damage
    }

    fn sprites<'a>(&'a self, assets: &'a Assets) -> &'a CharacterSprites {
        self.former_sprites.as_ref().unwrap_or(&assets.character)
    }
}

impl MortarMayhem {
    pub(super) fn shown_scene(&self) -> Scene {
        let (sprites, character) = self.shown_character();
        Scene {
            spared: self.visible_fire(),
            character: *character,
            former_sprites: (!Arc::ptr_eq(sprites, &self.assets.character)).then(|| Arc::clone(sprites)),
            command: self.state.shown_command,
        }
    }

    /// The original's `_build_debug_surface`: the target is marked, and the clue goes on by one frame each time.
    pub(super) fn draw_debug_frame(&mut self, canvas: &mut Canvas<'_>) {
        self.assets.paint_arena(self.visible_fire(), canvas);
        let (sprites, character) = self.last_moved();
        sprites.draw(character, canvas);
        if !self.state.clue.is_over()
            && let Some(number) = self.state.viewed_clue.next_frame()
            && let Some(command) = self.state.commands.get(number)
        {
            self.assets.draw_command(*command, canvas);
        }
        let (left, top) = self.assets.corner(self.state.target);
        canvas.draw_circle(TARGET, (left + TILE / 2, top + TILE / 2), TILE / 2, TARGET_WIDTH);
    }
}

impl Assets {
    /// Paints the arena, which burns if a tile is spared.
    fn paint_arena(&self, spared: Option<(i32, i32)>, canvas: &mut Canvas<'_>) {
        match spared {
            None => canvas.paste(&self.calm),
            Some(tile) => {
                canvas.paste(&self.burning);
                let (left, top) = self.corner(tile);
                canvas.clipped(Rect::new(left, top, TILE, TILE)).paste(&self.calm);
            }
        }
    }

    /// The top left corner of a tile.
    fn corner(&self, (x, y): (i32, i32)) -> (i32, i32) {
        (self.arena.0 + x * TILE, self.arena.1 + y * TILE)
    }

    fn draw_command(&self, command: Command, canvas: &mut Canvas<'_>) {
        let (x, y) = COMMAND_CORNER;
        self.commands[command.index()].blit(canvas, x, y);
    }
}
