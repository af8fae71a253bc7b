//! The pictures made from a set of reset parameters.

use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

use super::parameters::{MAX_SPOTLIGHTS, Parameters, Variant};
use super::shape::Shape;
use crate::envs::character::CharacterSprites;
use crate::envs::{FRAME_BYTES, SCREEN};
use crate::raster::{Canvas, CornerRadii, Disc, DiscColumn, Rect, Rgb, Sprite, Surface, blend_keyed, copy_run};

const BLACK: Rgb = [0, 0, 0];
const WHITE: Rgb = [255, 255, 255];
const BLUE: Rgb = [0, 0, 255];
const RED: Rgb = [255, 0, 0];
const COIN: Rgb = [255, 255, 0];
const COIN_BORDER: Rgb = [255, 165, 0];
const EXIT_OPEN: Rgb = [48, 141, 70];
const EXIT_CLOSED: Rgb = [55, 55, 55];

/// Side of a background's tile in pixels: 50 on the original's screen of 336 pixels, cut to whole pixels on this one.
const TILE: usize = 12;

/// What covers the screen behind everything.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Ground {
    /// White tiles and blue ones.
    Blue,
    /// White tiles and red ones.
    Red,
    White,
    Black,
}

/// A background: a chessboard of two colours, which may be the same, as the columns of its first and second tiles.
#[derive(Clone, Copy, Debug)]
pub(super) struct Columns {
    colors: [Rgb; 2],
    columns: [[Rgb; SCREEN]; 2],
}

/// By column or row, whether it is one of a second tile.
const SECOND: [u8; SCREEN] = {
    let mut second = [0; SCREEN];
    let mut x = 0;
    while x < SCREEN {
        second[x] = (x / TILE % 2) as u8;
        x += 1;
    }
    second
};

impl Columns {
    /// The chessboard with the first colour in its corner.
    fn new(colors: [Rgb; 2]) -> Self {
        let column = |first: u8| SECOND.map(|second| colors[usize::from(first ^ second)]);
        Columns { colors, columns: [column(0), column(1)] }
    }

    #[inline]
    fn column(&self, x: usize) -> &[Rgb; SCREEN] {
        &self.columns[usize::from(SECOND[x] & 1)]
    }

    /// The background under a black surface of some `alpha`.
    pub fn shaded(&self, alpha: u8) -> Self {
        Columns::new(self.colors.map(|color| color.map(|channel| blend_keyed(0, channel, alpha))))
    }

    /// Paints everything.
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
        // The first two columns of tiles, and from then on what is painted already, twice as much each time.
        let mut painted = 2 * TILE;
        let first = canvas.pixels_mut().as_chunks_mut::<3>().0.as_chunks_mut::<SCREEN>().0.iter_mut().take(painted);
        first.enumerate().for_each(|(x, column)| *column = *self.column(x));
        while painted < SCREEN {
            let count = painted.min(SCREEN - painted);
            canvas.pixels_mut().copy_within(..count * SCREEN * 3, painted * SCREEN * 3);
            painted += count;
        }
    }

    /// Paints a disc.
    pub fn paint_disc(&self, canvas: &mut Canvas<'_>, disc: &Disc, center: (i32, i32)) {
        let (columns, rows) = (canvas.columns(), canvas.rows());
        for DiscColumn { x, rows } in disc.columns(center, &columns, rows) {
            copy_run(self.column(x)[rows.clone()].as_flattened(), canvas.run_mut(x, rows));
        }
    }

    fn picture(&self) -> Box<Frame> {
        let mut frame = Box::new([0; FRAME_BYTES]);
        self.paint(&mut Canvas::new(&mut *frame, SCREEN, SCREEN));
        frame
    }
}

/// All pixels of a screen.
pub(super) type Frame = [u8; FRAME_BYTES];

/// What backgrounds and things look like at some darkness.
#[derive(Debug)]
pub(super) struct Look {
    /// By [`Ground`].
    grounds: [Columns; 4],
    /// The same as pictures of the whole screen, made once they are asked for: few of the darknesses on the way last.
    pictures: [OnceLock<Box<Frame>>; 4],
    pub coin: Sprite,
    pub exit_closed: Sprite,
    pub exit_open: Sprite,
    pub character: CharacterSprites,
}

impl Look {
    fn shaded(&self, alpha: u8) -> Self {
        Look {
            grounds: self.grounds.map(|ground| ground.shaded(alpha)),
            pictures: Default::default(),
            coin: self.coin.shaded(alpha),
            exit_closed: self.exit_closed.shaded(alpha),
            exit_open: self.exit_open.shaded(alpha),
            character: self.character.shaded(alpha),
        }
    }

    /// A background, to be painted as a whole.
    #[inline]
    pub fn ground(&self, ground: Ground) -> &Columns {
        &self.grounds[ground as usize]
    }

    /// A background, to copy scattered pixels from.
    #[inline]
    pub fn picture(&self, ground: Ground) -> &Frame {
        self.pictures[ground as usize].get_or_init(|| self.ground(ground).picture())
    }
}

/// What all environments with the same reset parameters share.
#[derive(Debug)]
pub struct Assets {
    pub variant: Variant,
    pub parameters: Parameters,
    /// Within this many pixels of their centres the agent's border reaches coins and exit.
    pub coin_radius: i32,
    pub exit_radius: f64,
    /// Spotlights that an environment has at a time, more or less.
    pub most_spotlights: usize,
    pub(super) exit_side: i32,
    /// As it is lit.
    pub(super) lit: Look,
    /// By the darkness, made once it is that dark.
    dark: Box<[OnceLock<Box<Look>>; 256]>,
}

impl Assets {
    /// Makes the pictures.
    pub fn new(variant: Variant, parameters: Parameters) -> Self {
        let grounds = [[WHITE, BLUE], [WHITE, RED], [WHITE; 2], [BLACK; 2]];
        let coin_radius = (10.0 * parameters.coin_scale) as i32;
        let exit_side = (20.0 * parameters.exit_scale) as i32;
        // Made now, and not while it is played.
        let radii = parameters.spot_min_radius as i16..=parameters.spot_max_radius as i16;
        radii.map(Shape::of).for_each(|_| ());
        let [exit_closed, exit_open] = exit_pictures(exit_side, parameters.exit_scale);
        Assets {
            variant,
            coin_radius,
            exit_radius: 20.0 / 2.0 * parameters.exit_scale,
            most_spotlights: most_spotlights(&parameters),
            exit_side,
            lit: Look {
                grounds: grounds.map(Columns::new),
                pictures: Default::default(),
                coin: coin_picture(coin_radius, parameters.coin_scale),
                exit_closed,
                exit_open,
                character: CharacterSprites::new(parameters.agent_scale),
            },
            dark: Box::new([const { OnceLock::new() }; 256]),
            parameters,
        }
    }

    /// What everything looks like outside of the light.
    #[inline]
    pub(super) fn dark(&self, darkness: u8) -> &Look {
        self.dark[usize::from(darkness)].get_or_init(|| Box::new(self.lit.shaded(darkness)))
    }

    /// Radius of the agent in pixels.
    pub(super) fn agent_radius(&self) -> i32 {
        self.lit.character.radius()
    }
}

/// How many spotlights there are at a time once as many leave as come, with some to spare.
fn most_spotlights(parameters: &Parameters) -> usize {
    let lifetime = 1.0 / parameters.spot_min_speed.max(1e-9);
    let at_once = (lifetime / parameters.spawn_interval.max(1) as f64).min(parameters.num_spawns as f64);
    (parameters.initial_spawns + at_once as usize + 3).min(MAX_SPOTLIGHTS)
}

/// A surface that is transparent where nothing is painted on it, as the original makes it with the colour 255.
fn transparent(side: i32) -> Surface {
    let mut surface = Surface::new(side as usize, side as usize);
    surface.fill(BLUE);
    surface.set_color_key(Some(BLUE));
    surface
}

fn coin_picture(radius: i32, scale: f64) -> Sprite {
    let mut surface = transparent(2 * radius);
    surface.draw_circle(COIN, (radius, radius), radius, 0);
    // A border without width fills the coin.
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
