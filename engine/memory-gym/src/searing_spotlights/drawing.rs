//! Composes the pictures of Searing Spotlights into a frame.
//!
//! The original paints a black surface with transparent circles over the scene. Here the frame is filled with the darkened
//! background, and each circle repaints the lit scene within it, so that nothing dark is painted twice.

use super::circles::{Circle, Circles};
use super::config::BAR_HEIGHT;
use super::light::{LightChange, Pixels, disc, outline};
use super::pictures::{Assets, Pictures};
use super::scene::Scene;
use super::state::State;
use crate::screen::SCREEN;
use endless_gym_core::raster::{Canvas, Damage, DiscColumn, Rect, Sprite, blend_keyed, copy_run};

/// The area in which light and objects that are hidden in the dark are visible.
const BELOW_BAR: Rect = Rect { x: 0, y: BAR_HEIGHT as i32, width: SCREEN as i32, height: (SCREEN - BAR_HEIGHT) as i32 };

/// A selection of the objects on the background.
#[derive(Clone, Copy)]
struct Objects {
    coins: bool,
    exit: bool,
    agent: bool,
}

impl Objects {
    const NONE: Objects = Objects { coins: false, exit: false, agent: false };
    const ALL: Objects = Objects { coins: true, exit: true, agent: true };

    fn any(self) -> bool {
        self.coins || self.exit || self.agent
    }
}

impl Assets {
    /// Draws the original's ground-truth view: the light, with all objects above it.
    pub(super) fn draw_ground_truth(&self, state: &State, canvas: &mut Canvas<'_>) {
        let scene = Scene::ground_truth(state, &self.config);
        scene.paint_light(self, Objects::NONE, canvas);
        let nothing = Objects::NONE;
        for objects in
            [Objects { exit: true, ..nothing }, Objects { coins: true, ..nothing }, Objects { agent: true, ..nothing }]
        {
            scene.for_each_object(self, &self.lit, objects, |sprite, (x, y)| sprite.blit(canvas, x, y));
        }
        scene.bar.paint(self.config.variant, canvas);
    }
}

impl Scene {
    /// Paints the frame.
    pub(super) fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        let visible = self.visible_in_dark(assets);
        let hidden = Objects { coins: !visible.coins, exit: !visible.exit, agent: !visible.agent };
        // Nothing else is visible within the bar's rows.
        if canvas.rows().end > BAR_HEIGHT {
            if self.blacked_out {
                canvas.fill([0; 3]);
            } else {
                self.paint_light(assets, hidden, canvas);
            }
        }
        // Objects that are visible in the dark are above the light. Some are even above the bar, depending on which other
        // objects are visible.
        let below_bar = Objects {
            coins: visible.coins,
            exit: visible.exit && visible.coins,
            agent: visible.agent && visible.exit && visible.coins,
        };
        let above_bar =
            Objects { coins: false, exit: visible.exit && !below_bar.exit, agent: visible.agent && !below_bar.agent };
        self.for_each_object(assets, &assets.lit, below_bar, |sprite, (x, y)| sprite.blit(canvas, x, y));
        self.bar.paint(assets.config.variant, canvas);
        self.for_each_object(assets, &assets.lit, above_bar, |sprite, (x, y)| sprite.blit(canvas, x, y));
    }

    /// Changes a painted frame from `shown` to this scene.
    pub(super) fn repaint(&self, shown: &Scene, assets: &Assets, canvas: &mut Canvas<'_>) {
        let same_light = self.darkness == shown.darkness && self.blacked_out == shown.blacked_out;
        let same_background = self.background == shown.background;
        // Every background is black in full darkness.
        let same_dark = same_background || self.darkness == 255;
        let many = self.circles.len().max(shown.circles.len()) > Circles::MAX_NUMBERED;
        let same_coins = self.coins_visible == shown.coins_visible;
        if many || !same_light || !same_dark || !same_coins {
            return self.paint(assets, canvas);
        }
        let mut damage = Damage::new(SCREEN, SCREEN);
        let change = LightChange::new(shown, self);
        let outlined = self.outlined || shown.outlined;
        if outlined {
            change.bounds().for_each(|rect| damage.add(rect));
        } else {
            let [dark, lit] =
                [assets.dark(self.darkness), &assets.lit].map(|pictures| pictures.background(self.background));
            change.paint(dark, lit, canvas);
        }
        let visible = self.visible_in_dark(assets).any();
        if visible || self.darkness < 255 || outlined {
            self.add_objects(shown, assets, &change, &mut damage);
        } else {
            self.repaint_hidden_objects(shown, assets, &change, &mut canvas.clipped(BELOW_BAR));
        }
        if self.bar != shown.bar {
            if visible {
                self.bar.changes_since(&shown.bar).for_each(|field| damage.add(field));
            } else {
                // No object is above the bar.
                self.bar.repaint(&shown.bar, assets.config.variant, canvas);
            }
        }
        damage.repair(canvas, |canvas| self.paint(assets, canvas));
    }

    /// Adds the bounds of visible objects that have changed, or whose light has changed.
    fn add_objects(&self, shown: &Scene, assets: &Assets, change: &LightChange<'_>, damage: &mut Damage) {
        let visible = self.visible_in_dark(assets);
        for (objects, changed) in self.objects_since(shown) {
            let in_dark = self.darkness < 255
                || (objects.coins && visible.coins)
                || (objects.exit && visible.exit)
                || (objects.agent && visible.agent);
            if changed {
                for scene in [shown, self] {
                    scene.for_each_object(assets, &assets.lit, objects, |sprite, corner| {
                        let bounds = sprite.bounds_at(corner);
                        if in_dark || scene.lights(&bounds) {
                            damage.add(bounds);
                        }
                    });
                }
            } else {
                self.for_each_object(assets, &assets.lit, objects, |sprite, corner| {
                    let bounds = sprite.bounds_at(corner);
                    if change.reaches(&bounds) {
                        damage.add(bounds);
                    }
                });
            }
        }
    }

    /// Repaints the objects after [`LightChange::paint`] has painted the background. Only for full darkness in which all
    /// objects are hidden: their unlit parts are black already.
    fn repaint_hidden_objects(
        &self,
        shown: &Scene,
        assets: &Assets,
        change: &LightChange<'_>,
        canvas: &mut Canvas<'_>,
    ) {
        let mut differ = false;
        for (objects, changed) in self.objects_since(shown) {
            if changed {
                shown.for_each_object(assets, &assets.lit, objects, |sprite, corner| {
                    let bounds = sprite.bounds_at(corner);
                    for circle in self.circles.reaching(&bounds) {
                        differ = true;
                        let circle = self.circles.get(circle);
                        let background = assets.lit.background(self.background);
                        paint_disc(&circle, background, &mut canvas.clipped(bounds));
                    }
                });
            }
            self.for_each_object(assets, &assets.lit, objects, |sprite, corner| {
                if !differ {
                    let bounds = sprite.bounds_at(corner);
                    differ = if changed { self.lights(&bounds) } else { change.reaches(&bounds) };
                }
            });
        }
        if !differ {
            return;
        }
        self.for_each_object(assets, &assets.lit, Objects::ALL, |sprite, (x, y)| {
            let bounds = sprite.bounds_at((x, y));
            for circle in self.circles.reaching(&bounds) {
                let circle = self.circles.get(circle);
                sprite.blit_within(canvas, x, y, disc(circle.radius), circle.centre());
            }
        });
    }

    /// Whether a circle may light a pixel of a rectangle. Only for at most [`Circles::MAX_NUMBERED`] circles.
    fn lights(&self, rect: &Rect) -> bool {
        !self.circles.reaching(rect).is_empty()
    }

    /// Each kind of object, and whether objects of that kind have changed.
    fn objects_since(&self, shown: &Scene) -> [(Objects, bool); 3] {
        let nothing = Objects::NONE;
        [
            (Objects { coins: true, ..nothing }, self.coins != shown.coins),
            (Objects { exit: true, ..nothing }, self.exit != shown.exit),
            (Objects { agent: true, ..nothing }, self.agent != shown.agent),
        ]
    }

    /// The objects that are visible in the dark.
    fn visible_in_dark(&self, assets: &Assets) -> Objects {
        let parameters = &assets.config.parameters;
        Objects { coins: self.coins_visible, exit: parameters.exit_visible, agent: parameters.agent_visible }
    }

    /// Calls `paint` with the picture and the top left corner of each selected object, from bottom to top.
    #[inline]
    fn for_each_object(
        &self,
        assets: &Assets,
        pictures: &Pictures,
        objects: Objects,
        mut paint: impl FnMut(&Sprite, (i32, i32)),
    ) {
        if objects.coins {
            for (x, y) in &self.coins {
                paint(&pictures.coin, (x - assets.config.coin_radius, y - assets.config.coin_radius));
            }
        }
        if let Some(exit) = self.exit.filter(|_| objects.exit) {
            let picture = if exit.open { &pictures.exit_open } else { &pictures.exit_closed };
            let (x, y) = exit.location;
            paint(picture, (x - assets.config.exit_side / 2, y - assets.config.exit_side / 2));
        }
        if objects.agent {
            let (sprite, corner) = pictures.character.picture(&self.agent);
            paint(sprite, corner);
        }
    }

    /// Paints the background and the objects that are hidden in the dark, as the light shows them.
    fn paint_light(&self, assets: &Assets, hidden: Objects, canvas: &mut Canvas<'_>) {
        let dark = assets.dark(self.darkness);
        canvas.paste(dark.background(self.background).as_flattened().as_flattened());
        // Nothing is visible in full darkness.
        if self.darkness < 255 {
            self.for_each_object(assets, dark, hidden, |sprite, (x, y)| sprite.blit(canvas, x, y));
        }
        let background = assets.lit.background(self.background);
        let (columns, rows) = (canvas.columns(), canvas.rows());
        let clip = Rect::new(columns.start as i32, rows.start as i32, columns.len() as i32, rows.len() as i32);
        for circle in self.circles.iter().filter(|circle| circle.reaches(&clip)) {
            paint_disc(&circle, background, canvas);
            self.for_each_object(assets, &assets.lit, hidden, |sprite, (x, y)| {
                sprite.blit_within(canvas, x, y, disc(circle.radius), circle.centre());
            });
            if self.outlined {
                draw_outline(&circle, self.darkness, canvas);
            }
        }
    }
}

/// Paints the background within a circle.
fn paint_disc(circle: &Circle, background: &Pixels, canvas: &mut Canvas<'_>) {
    let (columns, rows) = (canvas.columns(), canvas.rows());
    for DiscColumn { x, rows } in disc(circle.radius).columns(circle.centre(), &columns, rows) {
        copy_run(background[x][rows.clone()].as_flattened(), canvas.run_mut(x, rows));
    }
}

/// Draws the white outline of a circle, which the original paints on the translucent dark surface.
fn draw_outline(circle: &Circle, alpha: u8, canvas: &mut Canvas<'_>) {
    let (columns, rows, (x, y)) = (canvas.columns(), canvas.rows(), circle.centre());
    for (right, down) in outline(circle.radius) {
        let (x, y) = ((x + right) as usize, (y + down) as usize);
        if columns.contains(&x) && rows.contains(&y) {
            let pixel = canvas.pixel_mut(x, y);
            *pixel = pixel.map(|channel| blend_keyed(255, channel, alpha));
        }
    }
}
