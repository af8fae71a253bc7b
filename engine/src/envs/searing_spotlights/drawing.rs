//! The pictures made from a set of reset parameters.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::parameters::{MAX_SPOTLIGHTS, Parameters, Variant};
use super::spotlight::Circle;
use crate::envs::SCREEN;
use crate::envs::background::{BACKGROUND_TILE, tiled_background};
use crate::envs::character::CharacterSprites;
use crate::raster::{Canvas, CornerRadii, Disc, Rect, Rgb, Sprite, Surface, blend_keyed, circle_outline, copy_run};

const BLACK: Rgb = [0, 0, 0];
const WHITE: Rgb = [255, 255, 255];
const BLUE: Rgb = [0, 0, 255];
const RED: Rgb = [255, 0, 0];
const COIN: Rgb = [255, 255, 0];
const COIN_BORDER: Rgb = [255, 165, 0];
const EXIT_OPEN: Rgb = [48, 141, 70];
const EXIT_CLOSED: Rgb = [55, 55, 55];

/// Bytes of a column of pixels.
const COLUMN: usize = SCREEN * 3;

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
pub(super) struct Columns([[u8; COLUMN]; 2]);

impl Columns {
    /// No light.
    pub const BLACK: Columns = Columns([[0; COLUMN]; 2]);

    fn of(surface: &Surface) -> Self {
        let columns = surface.pixels().as_chunks::<COLUMN>().0;
        Columns([columns[0], columns[BACKGROUND_TILE]])
    }

    #[inline]
    fn column(&self, x: usize) -> &[u8; COLUMN] {
        &self.0[x / BACKGROUND_TILE % 2]
    }

    /// The background under a black surface of some `alpha`.
    pub fn shaded(&self, alpha: u8) -> Self {
        match alpha {
            255 => Columns::BLACK,
            _ => Columns(self.0.map(|column| column.map(|channel| blend_keyed(0, channel, alpha)))),
        }
    }

    /// Paints everything.
    #[inline]
    pub fn paint(&self, canvas: &mut Canvas<'_>) {
        let first = canvas.rows().start * 3;
        canvas.runs_mut().for_each(|(x, run)| copy_run(&self.column(x)[first..][..run.len()], run));
    }

    /// Paints some rows of a column, as far as there are any.
    #[inline]
    pub fn paint_run(&self, canvas: &mut Canvas<'_>, x: usize, rows: Range<usize>) {
        if rows.start < rows.end {
            let bytes = rows.start * 3..rows.end * 3;
            copy_run(&self.column(x)[bytes.clone()], &mut canvas.pixels_mut()[x * COLUMN..][bytes]);
        }
    }
}

/// A spotlight's circle of some radius.
#[derive(Debug)]
pub(super) struct Shape {
    pub disc: Disc,
    outline: Vec<(i32, i32)>,
}

impl Shape {
    fn new(radius: i32) -> Self {
        Shape { disc: Disc::new(radius), outline: circle_outline(radius) }
    }

    /// Draws the white outline of a half transparent surface over what the circle has brought back.
    pub fn draw_outline(&self, canvas: &mut Canvas<'_>, centre: (i32, i32), alpha: u8) {
        let (columns, rows) = (canvas.columns(), canvas.rows());
        let pixels = canvas.pixels_mut().as_chunks_mut::<3>().0;
        for (x, y) in &self.outline {
            let (x, y) = ((centre.0 + x) as usize, (centre.1 + y) as usize);
            if columns.contains(&x) && rows.contains(&y) {
                let pixel = &mut pixels[x * SCREEN + y];
                *pixel = pixel.map(|channel| blend_keyed(255, channel, alpha));
            }
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
    /// The circles of all radii that these parameters allow, and the first of the radii.
    shapes: Vec<Shape>,
    first_radius: i32,
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
        let first_radius = parameters.spot_min_radius as i32;
        let last_radius = first_radius.max(parameters.spot_max_radius as i32);
        let [exit_closed, exit_open] = exit_pictures(exit_side, parameters.exit_scale);
        Assets {
            variant,
            character: CharacterSprites::new(parameters.agent_scale),
            coin_radius,
            exit_radius: 20.0 / 2.0 * parameters.exit_scale,
            most_spotlights: most_spotlights(&parameters),
            grounds: grounds.each_ref().map(Columns::of),
            shapes: (first_radius..=last_radius).map(Shape::new).collect(),
            first_radius,
            coin: coin_picture(coin_radius, parameters.coin_scale),
            exit_side,
            exit_closed,
            exit_open,
            parameters,
        }
    }
}

impl Assets {
    /// Hands out the shape of a circle. An episode's first frame may show one of other reset parameters.
    #[inline]
    pub(super) fn with_shape(&self, circle: &Circle, draw: impl FnOnce(&Shape)) {
        let radius = i32::from(circle.radius);
        match self.shapes.get((radius - self.first_radius) as usize) {
            Some(shape) => draw(shape),
            None => draw(&Shape::new(radius)),
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
