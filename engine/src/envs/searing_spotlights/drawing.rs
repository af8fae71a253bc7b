//! The pictures made from a set of reset parameters, and how a frame is put together.
//!
//! The original paints a black surface with transparent circles over the scene. Here nothing that stays dark is painted: the
//! frame is filled with the darkened background, and the circles bring the scene back, column by column.

use serde::{Deserialize, Serialize};

use super::parameters::{MAX_SPOTLIGHTS, Parameters, Variant};
use super::rules::{SearingSpotlights, State};
use crate::envs::background::{BACKGROUND_TILE, tiled_background};
use crate::envs::character::{Character, CharacterSprites};
use crate::envs::{FRAME_BYTES, SCREEN};
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
pub(super) const COLUMN: usize = SCREEN * 3;

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
struct Columns([[u8; COLUMN]; 2]);

impl Columns {
    fn of(surface: &Surface) -> Self {
        let columns = surface.pixels().as_chunks::<COLUMN>().0;
        Columns([columns[0], columns[BACKGROUND_TILE]])
    }

    #[inline]
    fn column(&self, x: usize) -> &[u8; COLUMN] {
        &self.0[x / BACKGROUND_TILE % 2]
    }

    /// The background under a black surface of some `alpha`.
    fn shaded(&self, alpha: u8) -> Self {
        Columns(self.0.map(|column| column.map(|channel| blend_keyed(0, channel, alpha))))
    }
}

/// A spotlight's circle of some radius.
#[derive(Debug)]
struct Shape {
    disc: Disc,
    outline: Vec<(i32, i32)>,
}

impl Shape {
    fn new(radius: i32) -> Self {
        Shape { disc: Disc::new(radius), outline: circle_outline(radius) }
    }

    /// Draws the white outline of a half transparent surface over what the circle has brought back.
    fn draw_outline(&self, canvas: &mut Canvas<'_>, centre: (i32, i32), alpha: u8) {
        let pixels = canvas.pixels_mut().as_chunks_mut::<3>().0;
        for (x, y) in &self.outline {
            let (x, y) = (centre.0 + x, centre.1 + y);
            let on_screen = |coordinate: i32| (0..SCREEN as i32).contains(&coordinate);
            if on_screen(x) && on_screen(y) {
                let pixel = &mut pixels[x as usize * SCREEN + y as usize];
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
    grounds: [Columns; 4],
    /// The circles of all radii that these parameters allow, and the first of the radii.
    shapes: Vec<Shape>,
    first_radius: i32,
    coin: Sprite,
    exit_side: i32,
    exit_closed: Sprite,
    exit_open: Sprite,
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
    /// Hands out the circle of some radius. An episode's first frame may show one of other reset parameters.
    #[inline]
    fn with_shape(&self, radius: i32, draw: impl FnOnce(&Shape)) {
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

/// Which of the things on the ground are meant.
#[derive(Clone, Copy)]
struct Things {
    coins: bool,
    exit: bool,
    agent: bool,
}

impl SearingSpotlights {
    pub(super) fn draw_frame(&self, frame: &mut [u8]) {
        let mut canvas = Canvas::new(&mut frame[..FRAME_BYTES], SCREEN, SCREEN);
        let (state, parameters) = (&self.state, &self.assets.parameters);
        let coins_shine = state.coins_shine(parameters);
        let shining = Things { coins: coins_shine, exit: parameters.exit_visible, agent: parameters.agent_visible };
        let hidden = Things { coins: !shining.coins, exit: !shining.exit, agent: !shining.agent };

        // Without a coin, the original paints the empty, black surface that was meant for it.
        let curtain = self.assets.variant.endless && state.coins.is_empty();
        let ground = if curtain { Ground::Black } else { state.ground };
        let agent = state.shown_agent();
        if curtain && coins_shine {
            canvas.fill(BLACK);
        } else {
            self.draw_scene(&mut canvas, ground, hidden, &agent);
        }
        // What shines is above the light; some of it is even above the bar, depending on what else shines.
        let below_bar = Things {
            coins: shining.coins,
            exit: shining.exit && shining.coins,
            agent: shining.agent && shining.exit && shining.coins,
        };
        let above_bar =
            Things { coins: false, exit: shining.exit && !below_bar.exit, agent: shining.agent && !below_bar.agent };
        for (things, then_bar) in [(below_bar, true), (above_bar, false)] {
            if things.coins || things.exit || things.agent {
                self.each(things, &agent, |sprite, (x, y)| sprite.blit(&mut canvas, x, y));
            }
            if then_bar {
                self.draw_bar(&mut canvas);
            }
        }
    }

    /// Draws what the original shows a person: the light, and over it everything that is hidden from the agent.
    pub(super) fn draw_truth(&self, canvas: &mut Canvas<'_>) {
        let nothing = Things { coins: false, exit: false, agent: false };
        let agent = self.state.true_agent();
        self.draw_scene(canvas, self.state.ground, nothing, &agent);
        for things in
            [Things { exit: true, ..nothing }, Things { coins: true, ..nothing }, Things { agent: true, ..nothing }]
        {
            self.each(things, &agent, |sprite, (x, y)| sprite.blit(canvas, x, y));
        }
        self.draw_bar(canvas);
    }

    /// Hands out the pictures of some things and the places of their top left corners, from the lowest to the uppermost.
    #[inline]
    fn each(&self, things: Things, agent: &Character, mut paint: impl FnMut(&Sprite, (i32, i32))) {
        let assets = &*self.assets;
        if things.coins {
            for (x, y) in &self.state.coins {
                paint(&assets.coin, (x - assets.coin_radius, y - assets.coin_radius));
            }
        }
        if let Some(exit) = self.state.exit.filter(|_| things.exit) {
            let picture = if exit.open { &assets.exit_open } else { &assets.exit_closed };
            let (x, y) = exit.location;
            paint(picture, (x - assets.exit_side / 2, y - assets.exit_side / 2));
        }
        if things.agent {
            let (sprite, corner) = assets.character.picture(agent);
            paint(sprite, corner);
        }
    }

    /// Draws the ground and what is hidden on it, as the light shows them.
    fn draw_scene(&self, canvas: &mut Canvas<'_>, ground: Ground, hidden: Things, agent: &Character) {
        let state = &self.state;
        let ground = &self.assets.grounds[ground as usize];
        let darkness = state.darkness;
        if darkness == 0 {
            fill_columns(canvas, ground);
            self.each(hidden, agent, |sprite, (x, y)| sprite.blit(canvas, x, y));
            return;
        }
        if darkness == 255 {
            canvas.pixels_mut().fill(0);
        } else {
            fill_columns(canvas, &ground.shaded(darkness));
            self.each(hidden, agent, |sprite, (x, y)| sprite.blit_shaded(canvas, x, y, darkness));
        }
        for circle in state.lit.iter().filter(|circle| circle.is_on_screen()) {
            self.assets.with_shape(circle.radius, |shape| {
                let centre = (circle.x, circle.y);
                let pixels = canvas.pixels_mut();
                for column in shape.disc.columns(centre, SCREEN, SCREEN) {
                    let bytes = column.rows.start * 3..column.rows.end * 3;
                    copy_run(&ground.column(column.x)[bytes.clone()], &mut pixels[column.x * COLUMN..][bytes]);
                }
                self.each(hidden, agent, |sprite, (x, y)| sprite.blit_within(canvas, x, y, &shape.disc, centre));
                if state.outlined {
                    shape.draw_outline(canvas, centre, darkness);
                }
            });
        }
    }
}

fn fill_columns(canvas: &mut Canvas<'_>, ground: &Columns) {
    for (x, column) in canvas.pixels_mut().as_chunks_mut::<COLUMN>().0.iter_mut().enumerate() {
        *column = *ground.column(x);
    }
}

impl State {
    /// The agent as the frame shows it: an episode's first frame turns it upwards.
    pub fn shown_agent(&self) -> Character {
        if self.first_frame { Character { rotation: 0, ..self.agent } } else { self.agent }
    }

    /// The agent as the ground-truth view shows it: that of the last episode until the agent of this one has moved, as in the
    /// original, but in this one's size.
    fn true_agent(&self) -> Character {
        match self.former_agent {
            Some(former) if self.first_frame => former,
            _ => self.shown_agent(),
        }
    }
}
