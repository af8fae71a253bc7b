//! The pictures of Searing Spotlights.

use std::sync::OnceLock;

use super::config::Config;
use super::parameters::{Parameters, Variant};
use super::shape::Shape;
use super::state::Background;
use crate::envs::character_sprites::CharacterSprites;
use crate::envs::screen::{FRAME_BYTES, Frame, SCREEN};
use crate::raster::{Canvas, CornerRadii, Disc, DiscColumn, Rect, Rgb, Sprite, Surface, blend_keyed, copy_run};

const BLACK: Rgb = [0, 0, 0];
const WHITE: Rgb = [255, 255, 255];
const BLUE: Rgb = [0, 0, 255];
const RED: Rgb = [255, 0, 0];
const COIN: Rgb = [255, 255, 0];
const COIN_BORDER: Rgb = [255, 165, 0];
const EXIT_OPEN: Rgb = [48, 141, 70];
const EXIT_CLOSED: Rgb = [55, 55, 55];

/// Side of a background's tile in pixels: 50 on the original's screen of 336 pixels, truncated at this scale.
const TILE: usize = 12;

/// A background: a chessboard of two colours, which may be equal, stored as the pixels of its two different columns.
#[derive(Clone, Copy, Debug)]
pub(super) struct Chessboard {
    colors: [Rgb; 2],
    columns: [[Rgb; SCREEN]; 2],
}

/// For each column or row, 1 if its first tile has the second colour.
const SECOND: [u8; SCREEN] = {
    let mut second = [0; SCREEN];
    let mut x = 0;
    while x < SCREEN {
        second[x] = (x / TILE % 2) as u8;
        x += 1;
    }
    second
};

impl Chessboard {
    /// A chessboard with the first colour in its corner.
    fn new(colors: [Rgb; 2]) -> Self {
        let column = |first: u8| SECOND.map(|second| colors[usize::from(first ^ second)]);
        Chessboard { colors, columns: [column(0), column(1)] }
    }

    #[inline]
    fn column(&self, x: usize) -> &[Rgb; SCREEN] {
        &self.columns[usize::from(SECOND[x] & 1)]
    }

    /// The background under a black surface of some `alpha`.
    pub fn shaded(&self, alpha: u8) -> Self {
        Chessboard::new(self.colors.map(|color| color.map(|channel| blend_keyed(0, channel, alpha))))
    }

    /// Paints the whole background within the canvas' clip.
    #[inline]
    pub fn paint(&self, canvas: &mut Canvas<'_>) {
        if self.colors[0] == self.colors[1] {
            return canvas.fill(self.colors[0]);
        }
        let (columns, rows) = (canvas.columns(), canvas.rows());
        if columns.len() < SCREEN || rows.len() < SCREEN {
            canvas.runs_mut().for_each(|(x, run)| copy_run(self.column(x)[rows.clone()].as_flattened(), run));
            return;
        }
        canvas.mark_dirty(columns, &rows);
        // Paints the first two columns of tiles, then copies what is painted, doubling it each time.
        let mut painted = 2 * TILE;
        let first = canvas.pixels_mut().as_chunks_mut::<3>().0.as_chunks_mut::<SCREEN>().0.iter_mut().take(painted);
        first.enumerate().for_each(|(x, column)| *column = *self.column(x));
        while painted < SCREEN {
            let count = painted.min(SCREEN - painted);
            canvas.pixels_mut().copy_within(..count * SCREEN * 3, painted * SCREEN * 3);
            painted += count;
        }
    }

    /// Paints the background within a disc.
    pub fn paint_disc(&self, canvas: &mut Canvas<'_>, disc: &Disc, center: (i32, i32)) {
        let (columns, rows) = (canvas.columns(), canvas.rows());
        for DiscColumn { x, rows } in disc.columns(center, &columns, rows) {
            copy_run(self.column(x)[rows.clone()].as_flattened(), canvas.run_mut(x, rows));
        }
    }

    fn frame(&self) -> Box<Frame> {
        let mut frame = Box::new([0; FRAME_BYTES]);
        self.paint(&mut Canvas::new(&mut *frame, SCREEN, SCREEN));
        frame
    }
}

/// The pictures of backgrounds and objects at one darkness.
#[derive(Debug)]
pub(super) struct Pictures {
    /// By [`Background`].
    backgrounds: [Chessboard; 4],
    /// The backgrounds as whole frames, created on first use, since most darknesses occur for one step only.
    background_frames: [OnceLock<Box<Frame>>; 4],
    pub coin: Sprite,
    pub exit_closed: Sprite,
    pub exit_open: Sprite,
    pub character: CharacterSprites,
}

impl Pictures {
    /// The pictures under a black surface of some `alpha`.
    fn shaded(&self, alpha: u8) -> Self {
        Pictures {
            backgrounds: self.backgrounds.map(|background| background.shaded(alpha)),
            background_frames: Default::default(),
            coin: self.coin.shaded(alpha),
            exit_closed: self.exit_closed.shaded(alpha),
            exit_open: self.exit_open.shaded(alpha),
            character: self.character.shaded(alpha),
        }
    }

    /// A background, to paint areas with.
    #[inline]
    pub fn background(&self, background: Background) -> &Chessboard {
        &self.backgrounds[background as usize]
    }

    /// A background as a whole frame, to copy scattered pixels from.
    #[inline]
    pub fn background_frame(&self, background: Background) -> &Frame {
        self.background_frames[background as usize].get_or_init(|| self.background(background).frame())
    }
}

/// What all environments with the same reset parameters share: the configuration and the pictures.
#[derive(Debug)]
pub struct Assets {
    /// What the rules need.
    pub config: Config,
    /// The pictures in full light.
    pub(super) lit: Pictures,
    /// The pictures by darkness, created on first use.
    dark: Box<[OnceLock<Box<Pictures>>; 256]>,
}

impl Assets {
    /// Draws the pictures.
    pub fn new(variant: Variant, parameters: Parameters) -> Self {
        let colors = [[WHITE, BLUE], [WHITE, RED], [WHITE; 2], [BLACK; 2]];
        // Created in advance, so that no step needs to.
        let radii = parameters.spot_min_radius as i16..=parameters.spot_max_radius as i16;
        radii.map(Shape::of).for_each(|_| ());
        let config = Config::new(variant, parameters);
        let parameters = &config.parameters;
        let [exit_closed, exit_open] = exit_pictures(config.exit_side, parameters.exit_scale);
        Assets {
            lit: Pictures {
                backgrounds: colors.map(Chessboard::new),
                background_frames: Default::default(),
                coin: coin_picture(config.coin_radius, parameters.coin_scale),
                exit_closed,
                exit_open,
                character: CharacterSprites::new(parameters.agent_scale),
            },
            dark: Box::new([const { OnceLock::new() }; 256]),
            config,
        }
    }

    /// The pictures outside of the light, at a darkness of 0 to 255.
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
