//! The pictures made from a set of reset parameters.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::parameters::{MAX_SPOTLIGHTS, Parameters, Variant};
use super::shape::Shape;
use crate::envs::SCREEN;
use crate::envs::character::CharacterSprites;
use crate::raster::{Canvas, CornerRadii, Rect, Rgb, Sprite, Surface, blend_keyed, copy_run};

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

    /// The background's pixel at some place.
    #[inline]
    pub fn pixel(&self, x: usize, y: usize) -> Rgb {
        self.column(x)[y]
    }

    /// The background under a black surface of some `alpha`.
    pub fn shaded(&self, alpha: u8) -> Self {
        Columns::new(self.colors.map(|color| color.map(|channel| blend_keyed(0, channel, alpha))))
    }

    /// Paints everything.
    #[inline]
    pub fn paint(&self, canvas: &mut Canvas<'_>) {
        let rows = canvas.rows();
        canvas.runs_mut().for_each(|(x, run)| copy_run(self.column(x)[rows.clone()].as_flattened(), run));
    }

    /// Paints some rows of a column, as far as there are any.
    #[inline]
    pub fn paint_run(&self, canvas: &mut Canvas<'_>, x: usize, rows: Range<usize>) {
        if rows.start < rows.end {
            copy_run(self.column(x)[rows.clone()].as_flattened(), canvas.run_mut(x, rows));
        }
    }
}

/// What all environments with the same reset parameters share.
#[derive(Debug)]
pub struct Assets {
    pub variant: Variant,
    pub parameters: Parameters,
    pub character: CharacterSprites,
    /// Within this many pixels of their centres the agent's border reaches coins and exit.
    pub coin_radius: i32,
    pub exit_radius: f64,
    /// Spotlights that an environment has at a time, more or less.
    pub most_spotlights: usize,
    /// By [`Ground`].
    pub(super) grounds: [Columns; 4],
    pub(super) coin: Sprite,
    pub(super) exit_side: i32,
    pub(super) exit_closed: Sprite,
    pub(super) exit_open: Sprite,
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
            character: CharacterSprites::new(parameters.agent_scale),
            coin_radius,
            exit_radius: 20.0 / 2.0 * parameters.exit_scale,
            most_spotlights: most_spotlights(&parameters),
            grounds: grounds.map(Columns::new),
            coin: coin_picture(coin_radius, parameters.coin_scale),
            exit_side,
            exit_closed,
            exit_open,
            parameters,
        }
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
