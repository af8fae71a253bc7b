//! The pictures of Mystery Path, and how they are composed into a frame.

use super::config::{Config, TILE};
use super::parameters::{Parameters, Variant};
use super::path::{GRID, Tile};
use super::scene::Scene;
use super::state::State;
use crate::character_sprites::CharacterSprites;
use crate::screen::{FRAME, SCREEN};
use endless_gym_core::raster::{Canvas, Damage, Rect, Rgb, Sprite, Surface};

const BLACK: Rgb = [0, 0, 0];
const WHITE: Rgb = [255, 255, 255];
const RED: Rgb = [255, 0, 0];
const GREEN: Rgb = [0, 255, 0];
const BLUE: Rgb = [0, 0, 255];
const TILE_BORDER: Rgb = [210, 210, 210];
const BACKGROUND: Rgb = [125, 177, 250];

/// Side of the red cross and width of its lines in pixels.
const CROSS: i32 = 10;
const CROSS_LINES: i32 = 3;
/// Width of the stamina bar in pixels.
const STAMINA_BAR: i32 = 4;
/// Opacity of the path in the endless id's ground-truth view, 0 to 255.
const PATH_ALPHA: i32 = 200;

/// Shared by all environments with the same reset parameters: the configuration and the pictures.
#[derive(Debug)]
pub struct Assets {
    /// Configuration of the rules.
    pub config: Config,
    character: CharacterSprites,
    cross: Sprite,
    /// A tile of the past path.
    past_tile: Sprite,
    /// A path tile in the ground-truth view.
    path_tile: Surface,
    /// The screen and one more column of tiles; empty if there is no background.
    background: Vec<u8>,
}

impl Assets {
    /// Draws the pictures.
    pub fn new(variant: Variant, parameters: Parameters) -> Self {
        Assets {
            character: CharacterSprites::new(parameters.agent_scale),
            cross: Sprite::new(&cross()),
            past_tile: Sprite::new(&bordered_tile(WHITE)),
            path_tile: path_tile(),
            background: if parameters.show_background { background() } else { Vec::new() },
            config: Config::new(variant, parameters),
        }
    }
}

fn cross() -> Surface {
    let mut surface = Surface::new(CROSS as usize, CROSS as usize);
    surface.set_color_key(Some(BLACK));
    surface.draw_line(RED, (0, 0), (CROSS - 1, CROSS - 1), CROSS_LINES);
    surface.draw_line(RED, (CROSS - 1, 0), (0, CROSS - 1), CROSS_LINES);
    surface
}

fn bordered_tile(color: Rgb) -> Surface {
    let mut surface = Surface::new(TILE as usize, TILE as usize);
    surface.fill(color);
    surface.draw_rect(TILE_BORDER, tile_rect(0, 0), 1);
    surface
}

fn path_tile() -> Surface {
    let mut surface = Surface::new(TILE as usize, TILE as usize);
    surface.fill(WHITE);
    surface.set_color_key(Some(BLACK));
    surface.set_alpha(PATH_ALPHA);
    surface
}

fn background() -> Vec<u8> {
    let tile = bordered_tile(BACKGROUND);
    let mut surface = Surface::new(SCREEN + TILE as usize, SCREEN);
    for x in 0..=GRID {
        for y in 0..GRID {
            surface.blit(&tile, x * TILE, y * TILE);
        }
    }
    surface.into_pixels()
}

/// The square of a tile with its top left corner at that position.
fn tile_rect(left: i32, top: i32) -> Rect {
    Rect { x: left, y: top, width: TILE, height: TILE }
}

fn fill_tile(canvas: &mut Canvas<'_>, (x, y): Tile, color: Rgb) {
    canvas.draw_rect(color, tile_rect(x * TILE, y * TILE), 0);
}

impl Scene {
    /// Paints the frame.
    pub(super) fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        assets.paint_background(self.background, canvas);
        if let Some(goal) = self.goal {
            fill_tile(canvas, goal, GREEN);
        }
        if let Some(origin) = self.origin {
            fill_tile(canvas, origin, BLUE);
        }
        self.past.positions().for_each(|(left, top)| assets.draw_past_tile(canvas, left, top));
        assets.character.draw(&self.agent, canvas);
        if let Some(spent) = self.spent {
            draw_stamina(spent, canvas);
        }
        if let Some(centre) = self.cross {
            assets.draw_cross(centre, canvas);
        }
    }

    /// The rectangles in which this scene's frame differs from `shown`'s.
    pub(super) fn damage_since(&self, shown: &Scene, assets: &Assets) -> Damage {
        let mut damage = Damage::new(SCREEN, SCREEN);
        if self.background != shown.background {
            damage.add(Rect::new(0, 0, SCREEN as i32, SCREEN as i32));
            return damage;
        }
        let mut add_tile = |tile: Option<Tile>| {
            if let Some((x, y)) = tile {
                damage.add(tile_rect(x * TILE, y * TILE));
            }
        };
        if self.goal != shown.goal {
            add_tile(shown.goal);
            add_tile(self.goal);
        }
        if self.origin != shown.origin {
            add_tile(shown.origin);
            add_tile(self.origin);
        }
        if self.past != shown.past {
            let positions = shown.past.positions().chain(self.past.positions());
            positions.for_each(|(left, top)| damage.add(tile_rect(left, top)));
        }
        if self.agent != shown.agent {
            damage.add(assets.character.bounds(&shown.agent));
            damage.add(assets.character.bounds(&self.agent));
        }
        if self.spent != shown.spent {
            damage.add(stamina_bar(0, SCREEN as i32));
        }
        if self.cross != shown.cross {
            let bounds = |centre: (i32, i32)| assets.cross.bounds_at(cross_corner(centre));
            [shown.cross, self.cross].into_iter().flatten().for_each(|centre| damage.add(bounds(centre)));
        }
        damage
    }
}

/// The rectangle of `height` rows of the stamina bar, from row `y` on.
fn stamina_bar(y: i32, height: i32) -> Rect {
    Rect { x: SCREEN as i32 - STAMINA_BAR, y, width: STAMINA_BAR, height }
}

fn draw_stamina(spent: i32, canvas: &mut Canvas<'_>) {
    canvas.draw_rect(RED, stamina_bar(0, spent), 0);
    canvas.draw_rect(GREEN, stamina_bar(spent, SCREEN as i32 - spent), 0);
}

fn cross_corner((x, y): (i32, i32)) -> (i32, i32) {
    (x - CROSS / 2, y - CROSS / 2)
}

impl Assets {
    /// Draws the original's ground-truth view, with what the observation hides: the finite ids' path, goal, origin and walls,
    /// or the endless id's whole path and stamina.
    pub(super) fn draw_ground_truth(&self, state: &State, canvas: &mut Canvas<'_>) {
        self.paint_background(state.endless.background, canvas);
        if self.config.variant == Variant::Endless {
            // The position of the whole path's picture is truncated to whole pixels once, unlike the positions of the past
            // path's tiles.
            let shift = -state.endless.camera as i32;
            for (x, y) in state.route.tiles() {
                canvas.blit(&self.path_tile, x * TILE + shift, y * TILE);
            }
        } else {
            state.route.tiles().iter().for_each(|tile| fill_tile(canvas, *tile, WHITE));
            fill_tile(canvas, state.route.end(), GREEN);
            fill_tile(canvas, state.route.start(), BLUE);
            state.route.walls().for_each(|tile| fill_tile(canvas, tile, RED));
        }
        self.character.draw(&state.shown_agent(&self.config), canvas);
        if let Some(centre) = state.cross {
            self.draw_cross(centre, canvas);
        }
        if self.config.variant == Variant::Endless {
            draw_stamina(state.spent_stamina(&self.config), canvas);
        }
    }

    fn paint_background(&self, scrolled: i32, canvas: &mut Canvas<'_>) {
        if self.background.is_empty() {
            canvas.fill(BLACK);
        } else {
            canvas.paste(&self.background[scrolled as usize * SCREEN * 3..][..FRAME.bytes()]);
        }
    }

    fn draw_cross(&self, centre: (i32, i32), canvas: &mut Canvas<'_>) {
        let (x, y) = cross_corner(centre);
        self.cross.blit(canvas, x, y);
    }

    fn draw_past_tile(&self, canvas: &mut Canvas<'_>, left: i32, top: i32) {
        if (0..=SCREEN as i32 - TILE).contains(&left) {
            self.past_tile.blit(canvas, left, top);
        } else {
            // The border covers the last two pixels of a tile that leaves the screen, so a clipped picture would differ.
            canvas.draw_rect(WHITE, tile_rect(left, top), 0);
            canvas.draw_rect(TILE_BORDER, tile_rect(left, top), 1);
        }
    }
}
