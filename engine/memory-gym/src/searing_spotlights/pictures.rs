//! The pictures of Searing Spotlights.

use std::sync::OnceLock;

use super::config::Config;
use super::light::{self, Pixels};
use super::parameters::{Parameters, Variant};
use super::state::Background;
use crate::character_sprites::CharacterSprites;
use endless_gym_core::raster::{CornerRadii, Rect, Rgb, Sprite, Surface, blend_keyed};

const BLACK: Rgb = [0, 0, 0];
const WHITE: Rgb = [255, 255, 255];
const BLUE: Rgb = [0, 0, 255];
const RED: Rgb = [255, 0, 0];
const COIN: Rgb = [255, 255, 0];
const COIN_BORDER: Rgb = [255, 165, 0];
const EXIT_OPEN: Rgb = [48, 141, 70];
const EXIT_CLOSED: Rgb = [55, 55, 55];

/// Side of a background tile in pixels: 50 on the original's screen of 336 pixels, truncated at this scale.
const TILE: usize = 12;

/// A chessboard of two colours, which may be equal, with the first one in its corner.
fn chessboard(colors: [Rgb; 2]) -> Box<Pixels> {
    let pixel = |x: usize, y: usize| colors[(x / TILE + y / TILE) % 2];
    Box::new(std::array::from_fn(|x| std::array::from_fn(|y| pixel(x, y))))
}

/// The pictures of backgrounds and objects at one darkness.
#[derive(Debug)]
pub(super) struct Pictures {
    /// The colours of the tiles, indexed by [`Background`].
    tiles: [[Rgb; 2]; 4],
    /// Indexed by [`Background`]. Created on first use, since most darknesses last only one step.
    backgrounds: [OnceLock<Box<Pixels>>; 4],
    pub coin: Sprite,
    pub exit_closed: Sprite,
    pub exit_open: Sprite,
    pub character: CharacterSprites,
}

impl Pictures {
    /// The pictures as seen through a black surface with the given `alpha`.
    fn shaded(&self, alpha: u8) -> Self {
        Pictures {
            tiles: self.tiles.map(|colors| colors.map(|color| color.map(|channel| blend_keyed(0, channel, alpha)))),
            backgrounds: Default::default(),
            coin: self.coin.shaded(alpha),
            exit_closed: self.exit_closed.shaded(alpha),
            exit_open: self.exit_open.shaded(alpha),
            character: self.character.shaded(alpha),
        }
    }

    #[inline]
    pub fn background(&self, background: Background) -> &Pixels {
        let number = background as usize;
        self.backgrounds[number].get_or_init(|| chessboard(self.tiles[number]))
    }
}

/// Shared by all environments with the same reset parameters: the configuration and the pictures.
#[derive(Debug)]
pub struct Assets {
    /// Configuration of the rules.
    pub config: Config,
    /// The pictures in full light.
    pub(super) lit: Pictures,
    /// The pictures by darkness, created on first use.
    dark: Box<[OnceLock<Box<Pictures>>; 256]>,
}

impl Assets {
    /// Draws the pictures.
    pub fn new(variant: Variant, parameters: Parameters) -> Self {
        let tiles = [[WHITE, BLUE], [WHITE, RED], [WHITE; 2], [BLACK; 2]];
        // Created in advance, so that no step has to.
        (parameters.spot_min_radius as i16..=parameters.spot_max_radius as i16).for_each(light::prepare);
        let config = Config::new(variant, parameters);
        let parameters = &config.parameters;
        let [exit_closed, exit_open] = exit_pictures(config.exit_side, parameters.exit_scale);
        Assets {
            lit: Pictures {
                tiles,
                backgrounds: Default::default(),
                coin: coin_picture(config.coin_radius, parameters.coin_scale),
                exit_closed,
                exit_open,
                character: CharacterSprites::new(parameters.agent_scale),
            },
            dark: Box::new([const { OnceLock::new() }; 256]),
            config,
        }
    }

    /// The pictures outside the light, at a darkness of 0 to 255.
    #[inline]
    pub(super) fn dark(&self, darkness: u8) -> &Pictures {
        self.dark[usize::from(darkness)].get_or_init(|| Box::new(self.lit.shaded(darkness)))
    }
}

/// A surface that is transparent where nothing is painted, with the original's transparent colour 255.
fn transparent(side: i32) -> Surface {
    let mut surface = Surface::new(side as usize, side as usize);
    surface.fill(BLUE);
    surface.set_color_key(Some(BLUE));
    surface
}

fn coin_picture(radius: i32, scale: f64) -> Sprite {
    let mut surface = transparent(2 * radius);
    surface.draw_circle(COIN, (radius, radius), radius, 0);
    // A border of width 0 fills the coin.
    surface.draw_circle(COIN_BORDER, (radius, radius), radius, (2.0 * scale) as i32);
    Sprite::new(&surface)
}

/// The exit closed and open: an arch with a black border.
fn exit_pictures(side: i32, scale: f64) -> [Sprite; 2] {
    let corner = (10.0 * scale) as u32;
    let corners = CornerRadii { top_left: corner, top_right: corner, ..CornerRadii::default() };
    let rect = Rect::new(0, 0, side, side);
    let mut surface = transparent(side);
    [EXIT_CLOSED, EXIT_OPEN].map(|color| {
        surface.draw_rounded_rect(color, rect, 0, corners);
        surface.draw_rounded_rect(BLACK, rect, (2.0 * scale) as i32, corners);
        Sprite::new(&surface)
    })
}
