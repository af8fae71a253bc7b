//! The pictures made from a set of reset parameters.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::parameters::{MAX_SPOTLIGHTS, Parameters, Variant};
use super::shape::Shape;
use crate::envs::SCREEN;
use crate::envs::background::{BACKGROUND_TILE, tiled_background};
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

/// A background: the columns of its first and second tiles, which all others repeat.
#[derive(Clone, Copy, Debug)]
pub(super) struct Columns([[Rgb; SCREEN]; 2]);

/// By column, whether it is one of the first tiles or of the second.
const SECOND: [u8; SCREEN] = {
    let mut second = [0; SCREEN];
    let mut x = 0;
    while x < SCREEN {
        second[x] = (x / BACKGROUND_TILE % 2) as u8;
        x += 1;
    }
    second
};

impl Columns {
    /// No light.
    pub const BLACK: Columns = Columns([[BLACK; SCREEN]; 2]);

    fn of(surface: &Surface) -> Self {
        let columns = surface.pixels().as_chunks::<3>().0.as_chunks::<SCREEN>().0;
        Columns([columns[0], columns[BACKGROUND_TILE]])
    }

    #[inline]
    fn column(&self, x: usize) -> &[Rgb; SCREEN] {
        &self.0[usize::from(SECOND[x] & 1)]
    }

    /// The background's pixel at some place.
    #[inline]
    pub fn pixel(&self, x: usize, y: usize) -> Rgb {
        self.column(x)[y]
    }

    /// The background under a black surface of some `alpha`.
    pub fn shaded(&self, alpha: u8) -> Self {
        match alpha {
            255 => Columns::BLACK,
            _ => Columns(self.0.map(|column| column.map(|pixel| pixel.map(|channel| blend_keyed(0, channel, alpha))))),
        }
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
            let target = &mut canvas.pixels_mut()[(x * SCREEN + rows.start) * 3..][..rows.len() * 3];
            copy_run(self.column(x)[rows].as_flattened(), target);
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
        let plain = |color: Rgb| {
            let mut surface = Surface::new(SCREEN, SCREEN);
            surface.fill(color);
            surface
        };
        let grounds = [tiled_background(BLUE), tiled_background(RED), plain(WHITE), plain(BLACK)];
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
            grounds: grounds.each_ref().map(Columns::of),
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
