//! How the pictures of Searing Spotlights are composed into a frame.
//!
//! The original paints a black surface with transparent circles over the scene. Here the frame is filled with the
//! darkened background, and each circle repaints the lit scene within it, so that nothing that stays dark is painted
//! twice.

use super::circles::Circles;
use super::config::BAR_HEIGHT;
use super::light::LightChange;
use super::pictures::{Assets, Pictures};
use super::scene::Scene;
use super::shape::Shape;
use super::state::State;
use crate::envs::screen::SCREEN;
use crate::raster::{Canvas, Damage, Rect, Sprite};

/// Where light and objects that are hidden in the dark are visible.
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
    /// Draws the original's ground-truth view: the light, and above it every object.
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
        // Within the bar's rows nothing else is visible.
        if canvas.rows().end > BAR_HEIGHT {
            if self.blacked_out {
                canvas.fill([0; 3]);
            } else {
                self.paint_light(assets, hidden, canvas);
            }
        }
        // Objects that are visible in the dark are above the light. Some are even above the bar, depending on which
        // others are visible.
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
    #[inline(always)]
    pub(super) fn repaint(&self, shown: &Scene, assets: &Assets, canvas: &mut Canvas<'_>) {
        let same_light = self.darkness == shown.darkness && self.blacked_out == shown.blacked_out;
        // In full darkness every background is black.
        let same_background = self.background == shown.background || self.darkness == 255;
        let mut damage = Damage::new(SCREEN, SCREEN);
        let many = self.circles.len().max(shown.circles.len()) > Circles::MAX_NUMBERED;
        if many || !same_light || !same_background || self.coins_visible != shown.coins_visible {
            damage.add(Rect::new(0, 0, SCREEN as i32, SCREEN as i32));
            return damage.repair(canvas, |canvas| self.paint(assets, canvas));
        }
        let change = LightChange::new(shown, self);
        if self.outlined || shown.outlined {
            change.bounds().for_each(|rect| damage.add(rect));
        } else {
            change.paint(assets, canvas);
        }
        let visible = self.visible_in_dark(assets).any();
        if visible || self.darkness < 255 || self.outlined || shown.outlined || canvas.tracks_dirty() {
            self.add_objects(shown, assets, &change, &mut damage);
        } else {
            self.repaint_hidden_objects(shown, assets, &change, canvas);
        }
        if self.bar != shown.bar {
            if visible {
                self.bar.changes_since(&shown.bar).for_each(|field| damage.add(field));
            } else if !canvas.has_pixels() {
                self.bar.changes_since(&shown.bar).for_each(|field| canvas.mark_rect(field));
            } else {
                // No object is above the bar.
                self.bar.repaint(&shown.bar, assets.config.variant, canvas);
            }
        }
        damage.repair(canvas, |canvas| self.paint(assets, canvas));
    }

    /// Adds the bounds of visible objects that have changed or whose light has changed.
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

    /// Repaints the objects after [`LightChange::paint`] has painted the background. Only for full darkness with all objects hidden in
    /// it: what is not lit of them is black already.
    #[inline(always)]
    fn repaint_hidden_objects(
        &self,
        shown: &Scene,
        assets: &Assets,
        change: &LightChange<'_>,
        canvas: &mut Canvas<'_>,
    ) {
        let mut canvas = canvas.clipped(BELOW_BAR);
        let mut differ = false;
        for (objects, changed) in self.objects_since(shown) {
            if changed {
                shown.for_each_object(assets, &assets.lit, objects, |sprite, corner| {
                    let bounds = sprite.bounds_at(corner);
                    for circle in self.circles.reaching(&bounds) {
                        differ = true;
                        let circle = self.circles.get(circle);
                        let background = assets.lit.background(self.background);
                        let disc = &Shape::of(circle.radius).extent.disc;
                        background.paint_disc(&mut canvas.clipped(bounds), disc, circle.centre());
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
            for circle in self.circles.reaching(&sprite.bounds_at((x, y))) {
                let circle = self.circles.get(circle);
                sprite.blit_within(&mut canvas, x, y, &Shape::of(circle.radius).extent.disc, circle.centre());
            }
        });
    }

    /// Each kind of objects, and whether objects of that kind have changed.
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
    #[inline(always)]
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
        dark.background(self.background).paint(canvas);
        // In full darkness nothing is visible.
        if self.darkness < 255 {
            self.for_each_object(assets, dark, hidden, |sprite, (x, y)| sprite.blit(canvas, x, y));
        }
        let background = assets.lit.background(self.background);
        let (columns, rows) = (canvas.columns(), canvas.rows());
        let clip = Rect::new(columns.start as i32, rows.start as i32, columns.len() as i32, rows.len() as i32);
        for circle in self.circles.iter().filter(|circle| circle.reaches(&clip)) {
            let (shape, centre) = (Shape::of(circle.radius), circle.centre());
            background.paint_disc(canvas, &shape.extent.disc, centre);
            self.for_each_object(assets, &assets.lit, hidden, |sprite, (x, y)| {
                sprite.blit_within(canvas, x, y, &shape.extent.disc, centre);
            });
            if self.outlined {
                shape.draw_outline(canvas, centre, self.darkness);
            }
        }
    }
}
