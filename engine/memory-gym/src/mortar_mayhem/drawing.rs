//! The scene of a Mortar Mayhem frame, its pictures, and how they are composed.

use std::sync::Arc;

use super::commands::{COMMANDS, Command};
use super::config::{Config, TILE};
use super::parameters::{Parameters, Variant};
use super::state::{DisplayedCharacter, State};
use crate::character::Character;
use crate::character_sprites::CharacterSprites;
use crate::screen::SCREEN;
use endless_gym_core::raster::{Canvas, Damage, Rect, Rgb, Sprite, Surface};

const TILE_BORDER: i32 = 1;

/// Scale of the command pictures relative to the original's 336 pixel screen.
const COMMAND_SCALE: f64 = 0.25;
const WHITE: Rgb = [255, 255, 255];
const BLACK: Rgb = [0, 0, 0];

/// Side of an unrotated command picture in pixels.
const COMMAND_SIDE: i32 = (88.0 * COMMAND_SCALE) as i32;
/// Top left corner of the command pictures.
const COMMAND_CORNER: (i32, i32) = ((SCREEN as i32 - COMMAND_SIDE) / 2, (SCREEN as i32 - COMMAND_SIDE) / 2);

/// The ring that marks the target in the ground-truth view.
const TARGET: Rgb = [0, 255, 0];
const TARGET_WIDTH: i32 = 2;

/// Colours of a tile and of its border.
type TileColours = (Rgb, Rgb);
const CALM: TileColours = ([21, 43, 77], [29, 60, 107]);
const BURNING: TileColours = ([81, 18, 26], [112, 24, 36]);

/// Shared by all environments with the same reset parameters: the configuration and the pictures.
#[derive(Debug)]
pub struct Assets {
    /// Configuration of the rules.
    pub config: Config,
    /// The character's pictures.
    pub(super) character: Arc<CharacterSprites>,
    /// The empty arena with no tile burning.
    calm: Vec<u8>,
    /// The empty arena with all tiles burning.
    burning: Vec<u8>,
    commands: [Sprite; COMMANDS],
}

impl Assets {
    /// Draws the pictures.
    pub fn new(variant: Variant, parameters: Parameters) -> Self {
        let config = Config::new(variant, parameters);
        Assets {
            character: Arc::new(CharacterSprites::new(config.parameters.agent_scale)),
            calm: draw_arena(&config, CALM),
            burning: draw_arena(&config, BURNING),
            commands: command_sprites(),
            config,
        }
    }

    /// The pictures of the character that the state displays after an episode's first frame.
    pub(super) fn displayed_sprites(&self, state: &State) -> Arc<CharacterSprites> {
        match state.displayed {
            DisplayedCharacter::Earlier { scale, .. } if scale != self.config.parameters.agent_scale => {
                Arc::new(CharacterSprites::new(scale))
            }
            _ => Arc::clone(&self.character),
        }
    }

    /// Paints the arena. All tiles except `safe_tile` burn; without a `safe_tile`, none do.
    fn paint_arena(&self, safe_tile: Option<(i32, i32)>, canvas: &mut Canvas<'_>) {
        match safe_tile {
            None => canvas.paste(&self.calm),
            Some(tile) => {
                canvas.paste(&self.burning);
                let (left, top) = self.config.corner(tile);
                canvas.clipped(Rect::new(left, top, TILE, TILE)).paste(&self.calm);
            }
        }
    }

    fn draw_command(&self, command: Command, canvas: &mut Canvas<'_>) {
        let (x, y) = COMMAND_CORNER;
        self.commands[command.index()].blit(canvas, x, y);
    }

    /// Draws the original's `_build_debug_surface`, which marks the target and advances the shown commands by one frame per
    /// call. `earlier_sprites` are the pictures of an earlier episode's character.
    pub(super) fn draw_ground_truth(
        &self,
        state: &mut State,
        earlier_sprites: &CharacterSprites,
        canvas: &mut Canvas<'_>,
    ) {
        self.paint_arena(state.visible_fire(&self.config.parameters), canvas);
        let sprites = match state.displayed {
            DisplayedCharacter::Earlier { .. } => earlier_sprites,
            DisplayedCharacter::Initial | DisplayedCharacter::Current => &self.character,
        };
        sprites.draw(state.last_moved(), canvas);
        if !state.display.is_over()
            && let Some(index) = state.view_display.next_frame()
            && let Some(command) = state.commands.get(index)
        {
            self.draw_command(*command, canvas);
        }
        canvas.draw_circle(TARGET, self.config.centre(state.target), TILE / 2, TARGET_WIDTH);
    }
}

fn draw_arena(config: &Config, (fill, border): TileColours) -> Vec<u8> {
    let mut tile = Surface::new(TILE as usize, TILE as usize);
    tile.fill(fill);
    tile.draw_rect(border, Rect { x: 0, y: 0, width: TILE, height: TILE }, TILE_BORDER);
    let mut screen = Surface::new(SCREEN, SCREEN);
    for x in 0..config.parameters.arena_size {
        for y in 0..config.parameters.arena_size {
            let (left, top) = config.corner((x, y));
            screen.blit(&tile, left, top);
        }
    }
    screen.into_pixels()
}

/// What a frame shows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Scene {
    /// The only tile that does not burn, while the others do.
    pub(super) safe_tile: Option<(i32, i32)>,
    pub(super) character: Character,
    /// The character's pictures, if they belong to an earlier episode and differ from the current ones.
    pub(super) earlier_sprites: Option<Arc<CharacterSprites>>,
    pub(super) command: Option<Command>,
}

impl Scene {
    /// The scene of a state. `sprites` are the current episode's pictures, `earlier_sprites` those of an earlier episode's
    /// character.
    pub(super) fn new(
        state: &State,
        config: &Config,
        sprites: &Arc<CharacterSprites>,
        earlier_sprites: &Arc<CharacterSprites>,
    ) -> Self {
        let shows_earlier = !state.first_frame && matches!(state.displayed, DisplayedCharacter::Earlier { .. });
        let differs = shows_earlier && !Arc::ptr_eq(sprites, earlier_sprites);
        Scene {
            safe_tile: state.visible_fire(&config.parameters),
            character: *state.visible_character(),
            earlier_sprites: differs.then(|| Arc::clone(earlier_sprites)),
            command: state.shown_command,
        }
    }

    /// Paints the frame.
    pub(super) fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        assets.paint_arena(self.safe_tile, canvas);
        self.sprites(assets).draw(&self.character, canvas);
        if let Some(command) = self.command {
            assets.draw_command(command, canvas);
        }
    }

    /// The rectangles in which this scene's frame differs from `shown`'s. Unless painted pixels are `tracked`, they may be
    /// larger where larger ones are faster to paint.
    pub(super) fn damage_since(&self, shown: &Scene, assets: &Assets, tracked: bool) -> Damage {
        let mut damage = Damage::new(SCREEN, SCREEN);
        if self.safe_tile != shown.safe_tile {
            let (left, top, right, bottom) = assets.config.arena;
            // Whole columns are copied as one run.
            let (top, bottom) = if tracked { (top, bottom) } else { (0, SCREEN as i32) };
            damage.add(Rect::new(left, top, right - left, bottom - top));
        }
        if self.command != shown.command {
            let bounds = |command: Command| assets.commands[command.index()].bounds_at(COMMAND_CORNER);
            [shown.command, self.command].into_iter().flatten().for_each(|command| damage.add(bounds(command)));
        }
        if (&self.character, &self.earlier_sprites) != (&shown.character, &shown.earlier_sprites) {
            [shown, self].iter().for_each(|scene| damage.add(scene.sprites(assets).bounds(&scene.character)));
        }
        damage
    }

    fn sprites<'a>(&'a self, assets: &'a Assets) -> &'a CharacterSprites {
        self.earlier_sprites.as_ref().unwrap_or(&assets.character)
    }
}

/// The pictures of all commands, by number.
fn command_sprites() -> [Sprite; COMMANDS] {
    let pixels = |length: f64| (length * COMMAND_SCALE) as i32;
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
