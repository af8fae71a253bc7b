//! How Mystery Path looks: the pictures made once for each set of reset parameters, and how a frame is put together.

use super::parameters::{Parameters, Variant};
use super::path::{GRID, Tile, TileSet};
use super::rules::State;
use crate::envs::character::{Character, CharacterSprites};
use crate::envs::{FRAME_BYTES, SCREEN};
use crate::raster::{Canvas, Damage, Rect, Rgb, Sprite, Surface};

/// Side of a tile in pixels.
pub const TILE: i32 = SCREEN as i32 / GRID;

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
/// How much the ground truth covers the background of the endless id.
const PATH_ALPHA: i32 = 200;
/// Most tiles to the left of the agent that are on the screen.
const MAX_CAMERA_OFFSET: f64 = 5.5;

/// What all environments with the same reset parameters share.
#[derive(Debug)]
pub struct Assets {
    pub variant: Variant,
    pub parameters: Parameters,
    pub character: CharacterSprites,
    /// Left edge of the screen in pixels of the way, where an endless episode begins.
    pub camera: f64,
    /// Columns of the past path that are shown beside the agent's neighbour column.
    pub past_depth: i32,
    /// Where the centre of the endless agent stays on the screen.
    agent_x: i32,
    cross: Sprite,
    /// A tile of the past path, and one of the ground truth.
    past_tile: Sprite,
    path_tile: Surface,
    /// The screen and one more column of tiles; empty if there is no background.
    background: Vec<u8>,
}

impl Assets {
    /// Makes the pictures.
    pub fn new(variant: Variant, parameters: Parameters) -> Self {
        let character = CharacterSprites::new(parameters.agent_scale);
        let camera = match variant {
            Variant::Free | Variant::Grid => 0.0,
            Variant::Endless => -f64::from(TILE) * parameters.camera_offset_scale.clamp(0.0, MAX_CAMERA_OFFSET),
        };
        // The picture's left edge, cut towards zero when it is drawn.
        let left = f64::from(character.radius() - character.centre()) - camera;
        Assets {
            variant,
            camera,
            past_depth: parameters.camera_offset_scale as i32,
            agent_x: left as i32 + character.centre(),
            cross: Sprite::new(&cross()),
            past_tile: Sprite::new(&bordered_tile(WHITE)),
            path_tile: path_tile(),
            background: if parameters.show_background { background() } else { Vec::new() },
            character,
            parameters,
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
    surface.draw_rect(TILE_BORDER, tile_at(0, 0), 1);
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

/// The square of a tile whose top left corner is there.
fn tile_at(left: i32, top: i32) -> Rect {
    Rect { x: left, y: top, width: TILE, height: TILE }
}

fn fill_tile(canvas: &mut Canvas<'_>, (x, y): Tile, color: Rgb) {
    canvas.draw_rect(color, tile_at(x * TILE, y * TILE), 0);
}

/// What a frame shows.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    goal: Option<Tile>,
    origin: Option<Tile>,
    past: PastPath,
    agent: Character,
    /// Rows of the stamina bar that are red, if it is shown.
    spent: Option<i32>,
    /// Centre of the red cross.
    cross: Option<(i32, i32)>,
    /// Pixels that the background has scrolled to the left.
    background: i32,
}

/// The tiles of the past path that are on the screen.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct PastPath {
    /// Left edge of the screen in pixels of the way.
    camera: f64,
    /// The tiles' first column.
    first: i32,
    /// By their columns from the first.
    tiles: TileSet,
}

impl PastPath {
    /// The tiles, each with its left edge in pixels, cut towards zero as it is drawn, and its top edge.
    fn places(self) -> impl Iterator<Item = (i32, i32)> {
        self.tiles.iter().map(move |(x, y)| ((f64::from((self.first + x) * TILE) - self.camera) as i32, y * TILE))
    }
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
        self.past.places().for_each(|(left, top)| assets.draw_past_tile(canvas, left, top));
        assets.character.draw(&self.agent, canvas);
        if let Some(spent) = self.spent {
            draw_stamina(spent, canvas);
        }
        if let Some(centre) = self.cross {
            assets.draw_cross(centre, canvas);
        }
    }

    /// Where a frame that shows `shown` differs.
    pub(super) fn damage_since(&self, shown: &Scene, assets: &Assets) -> Damage {
        let mut damage = Damage::new(SCREEN, SCREEN);
        if self.background != shown.background {
            damage.add(Rect::new(0, 0, SCREEN as i32, SCREEN as i32));
            return damage;
        }
        let mut add_tile = |tile: Option<Tile>| {
            if let Some((x, y)) = tile {
                damage.add(tile_at(x * TILE, y * TILE));
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
            let places = shown.past.places().chain(self.past.places());
            places.for_each(|(left, top)| damage.add(tile_at(left, top)));
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

/// Part of the stamina bar.
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

impl State {
    pub(super) fn scene(&self, assets: &Assets) -> Scene {
        let parameters = &assets.parameters;
        Scene {
            goal: parameters.show_goal.then(|| self.route.end()),
            origin: parameters.show_origin.then(|| self.route.start()),
            past: if parameters.show_past_path { self.past(assets) } else { PastPath::default() },
            agent: self.shown_agent(assets),
            spent: parameters.show_stamina.then(|| self.spent_stamina(assets)),
            cross: self.cross,
            background: if parameters.show_background { self.journey.background() } else { 0 },
        }
    }

    /// Draws what the observation hides: the finite ids' path, goal, origin and walls, or the endless id's whole way and stamina.
    pub(super) fn draw_truth(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        assets.paint_background(self.journey.background(), canvas);
        if assets.variant == Variant::Endless {
            // The picture of the whole way is cut to whole pixels once, unlike the past path's tiles.
            let shift = -self.journey.camera() as i32;
            for (x, y) in self.route.tiles() {
                canvas.blit(&assets.path_tile, x * TILE + shift, y * TILE);
            }
        } else {
            self.route.tiles().iter().for_each(|tile| fill_tile(canvas, *tile, WHITE));
            fill_tile(canvas, self.route.end(), GREEN);
            fill_tile(canvas, self.route.start(), BLUE);
            self.route.walls().for_each(|tile| fill_tile(canvas, tile, RED));
        }
        assets.character.draw(&self.shown_agent(assets), canvas);
        if let Some(centre) = self.cross {
            assets.draw_cross(centre, canvas);
        }
        if assets.variant == Variant::Endless {
            draw_stamina(self.spent_stamina(assets), canvas);
        }
    }

    fn past(&self, assets: &Assets) -> PastPath {
        // Never more than eight columns are on the screen.
        let Some(first) = self.past_tiles(assets).map(|(_, (x, _))| x).min() else { return PastPath::default() };
        let mut past = PastPath { camera: self.journey.camera(), first, tiles: TileSet::default() };
        self.past_tiles(assets).for_each(|(_, (x, y))| past.tiles.insert((x - first, y)));
        past
    }

    /// The past path's tiles that are on the screen, each with its left edge in pixels, cut towards zero as it is drawn.
    pub(super) fn past_tiles(&self, assets: &Assets) -> impl Iterator<Item = (i32, Tile)> {
        let camera = self.journey.camera();
        self.journey
            .past_path(self.tile, assets.past_depth, &self.route)
            .map(move |(x, y)| ((f64::from(x * TILE) - camera) as i32, (x, y)))
            .filter(|(left, _)| (1 - TILE..SCREEN as i32).contains(left))
    }

    /// The agent at its place on the screen.
    pub(super) fn shown_agent(&self, assets: &Assets) -> Character {
        match assets.variant {
            Variant::Free | Variant::Grid => self.agent,
            Variant::Endless => Character { position: (assets.agent_x, self.agent.position.1), ..self.agent },
        }
    }

    fn spent_stamina(&self, assets: &Assets) -> i32 {
        let left = self.journey.stamina_share(assets.parameters.stamina_level);
        (SCREEN as f64 * (1.0 - left)) as i32
    }
}

impl Assets {
    fn paint_background(&self, scrolled: i32, canvas: &mut Canvas<'_>) {
        if self.background.is_empty() {
            canvas.fill(BLACK);
        } else {
            canvas.paste(&self.background[scrolled as usize * SCREEN * 3..][..FRAME_BYTES]);
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
            // A border covers the last two pixels of a tile that leaves the screen, so the picture cannot be cut.
            canvas.draw_rect(WHITE, tile_at(left, top), 0);
            canvas.draw_rect(TILE_BORDER, tile_at(left, top), 1);
        }
    }
}
