//! What a frame shows, and how it is put together.
//!
//! The original paints a black surface with transparent circles over the scene. Here nothing that stays dark is painted: the
//! frame is filled with the darkened background, and the circles bring the scene back, column by column.

use smallvec::SmallVec;

use super::drawing::{Assets, Ground, Look};
use super::light;
use super::rules::{BAR_HEIGHT, Exit, SearingSpotlights, State};
use super::shape::Shape;
use super::spotlight::Circle;
use super::top_bar::Bar;
use crate::envs::SCREEN;
use crate::envs::character::Character;
use crate::raster::{Canvas, Damage, Rect, Sprite};

/// Among more circles than these, it is faster to paint everything than to find out what has changed.
const MANY: usize = 64;

/// What a frame shows. Few frames have more circles and coins than there is room for without further memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    pub(super) ground: Ground,
    /// How dark it is outside of the circles.
    pub(super) darkness: u8,
    /// Nothing is seen but the bar and what shines in the dark.
    covered: bool,
    /// The circles have outlines.
    outlined: bool,
    coins_shine: bool,
    /// The lit circles on the screen, where it is not lit anyway.
    pub(super) circles: SmallVec<[Circle; 12]>,
    coins: SmallVec<[(i32, i32); 2]>,
    exit: Option<Exit>,
    agent: Character,
    bar: Bar,
}

/// Which of the things on the ground are meant.
#[derive(Clone, Copy)]
struct Things {
    coins: bool,
    exit: bool,
    agent: bool,
}

impl Things {
    fn any(self) -> bool {
        self.coins || self.exit || self.agent
    }
}

impl SearingSpotlights {
    pub(super) fn shown_scene(&self) -> Scene {
        let (state, parameters) = (&self.state, &self.assets.parameters);
        // Without a coin, the original paints the empty, black surface that was meant for it.
        let curtain = self.assets.variant.endless && state.coins.is_empty();
        let coins_shine = state.coins_shine(parameters);
        let covered = curtain && coins_shine;
        Scene {
            ground: if curtain { Ground::Black } else { state.ground },
            coins_shine,
            covered,
            circles: if covered { SmallVec::new() } else { state.shown_circles() },
            agent: state.shown_agent(),
            ..self.unlit_scene()
        }
    }

    /// What there is, with nothing that is hidden or covered.
    fn lit_scene(&self) -> Scene {
        Scene { circles: self.state.shown_circles(), agent: self.state.true_agent(), ..self.unlit_scene() }
    }

    /// A scene without circles.
    #[inline]
    fn unlit_scene(&self) -> Scene {
        let state = &self.state;
        Scene {
            ground: state.ground,
            darkness: state.darkness,
            covered: false,
            outlined: state.darkness > 0 && state.outlined,
            coins_shine: false,
            circles: SmallVec::new(),
            coins: SmallVec::from_slice(&state.coins),
            exit: state.exit,
            agent: Character::default(),
            bar: self.bar(),
        }
    }

    /// Draws what the original shows a person: the light, and over it everything that is hidden from the agent.
    pub(super) fn draw_truth(&self, canvas: &mut Canvas<'_>) {
        let nothing = Things { coins: false, exit: false, agent: false };
        let (assets, scene) = (&self.assets, self.lit_scene());
        scene.paint_light(assets, nothing, canvas);
        for things in
            [Things { exit: true, ..nothing }, Things { coins: true, ..nothing }, Things { agent: true, ..nothing }]
        {
            scene.each(assets, &assets.lit, things, |sprite, (x, y)| sprite.blit(canvas, x, y));
        }
        scene.bar.paint(assets.variant, canvas);
    }
}

impl State {
    /// The lit circles on the screen, where it is not lit anyway.
    fn shown_circles(&self) -> SmallVec<[Circle; 12]> {
        let mut circles = SmallVec::new();
        if self.darkness > 0 {
            for circle in self.lit.iter().filter(|circle| circle.is_on_screen()) {
                circles.push(*circle);
            }
        }
        circles
    }

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

impl Scene {
    /// Paints the frame.
    pub(super) fn paint(&self, assets: &Assets, canvas: &mut Canvas<'_>) {
        let shining = self.shining(assets);
        let hidden = Things { coins: !shining.coins, exit: !shining.exit, agent: !shining.agent };
        // The bar covers what lies behind it.
        if canvas.rows().end > BAR_HEIGHT {
            if self.covered {
                canvas.fill([0; 3]);
            } else {
                self.paint_light(assets, hidden, canvas);
            }
        }
        // What shines is above the light; some of it is even above the bar, depending on what else shines.
        let below_bar = Things {
            coins: shining.coins,
            exit: shining.exit && shining.coins,
            agent: shining.agent && shining.exit && shining.coins,
        };
        let above_bar =
            Things { coins: false, exit: shining.exit && !below_bar.exit, agent: shining.agent && !below_bar.agent };
        self.each(assets, &assets.lit, below_bar, |sprite, (x, y)| sprite.blit(canvas, x, y));
        self.bar.paint(assets.variant, canvas);
        self.each(assets, &assets.lit, above_bar, |sprite, (x, y)| sprite.blit(canvas, x, y));
    }

    /// Changes a frame that shows `shown`.
    pub(super) fn repaint(&self, shown: &Scene, assets: &Assets, canvas: &mut Canvas<'_>) {
        let lit_alike = self.darkness == shown.darkness && self.covered == shown.covered;
        // What is black is black on any ground.
        let ground_alike = self.ground == shown.ground || self.darkness == 255;
        let many = self.circles.len().max(shown.circles.len()) > MANY;
        if many || !lit_alike || !ground_alike || self.coins_shine != shown.coins_shine {
            return self.paint(assets, canvas);
        }
        let mut damage = Damage::new(SCREEN, SCREEN);
        let change = light::Change::new(shown, self);
        if self.outlined || shown.outlined {
            change.bounds().for_each(|light| damage.add(light));
        } else {
            change.paint(assets, canvas);
        }
        self.add_things(shown, assets, &change, &mut damage);
        if self.bar != shown.bar {
            if self.shining(assets).any() {
                self.bar.changes_since(&shown.bar).for_each(|field| damage.add(field));
            } else {
                // Nothing is above the bar.
                self.bar.repaint(&shown.bar, assets.variant, canvas);
            }
        }
        damage.repair(canvas, |canvas| self.paint(assets, canvas));
    }

    /// Adds the places of things that have changed or that the light has, as far as any of it is seen.
    fn add_things(&self, shown: &Scene, assets: &Assets, change: &light::Change<'_>, damage: &mut Damage) {
        let shining = self.shining(assets);
        let add = |things: Things, shines: bool, changed: bool, damage: &mut Damage| {
            if changed {
                for scene in [shown, self] {
                    scene.each(assets, &assets.lit, things, |sprite, corner| {
                        let bounds = sprite.bounds_at(corner);
                        if shines || self.darkness < 255 || scene.circles.iter().any(|circle| circle.reaches(&bounds)) {
                            damage.add(bounds);
                        }
                    });
                }
            } else {
                self.each(assets, &assets.lit, things, |sprite, corner| {
                    let bounds = sprite.bounds_at(corner);
                    if change.reaches(&bounds) {
                        damage.add(bounds);
                    }
                });
            }
        };
        let nothing = Things { coins: false, exit: false, agent: false };
        add(Things { coins: true, ..nothing }, shining.coins, self.coins != shown.coins, damage);
        add(Things { exit: true, ..nothing }, shining.exit, self.exit != shown.exit, damage);
        add(Things { agent: true, ..nothing }, shining.agent, self.agent != shown.agent, damage);
    }

    /// What is seen in the dark.
    fn shining(&self, assets: &Assets) -> Things {
        let parameters = &assets.parameters;
        Things { coins: self.coins_shine, exit: parameters.exit_visible, agent: parameters.agent_visible }
    }

    /// Hands out the pictures of some things and the places of their top left corners, from the lowest to the uppermost.
    #[inline]
    fn each(&self, assets: &Assets, look: &Look, things: Things, mut paint: impl FnMut(&Sprite, (i32, i32))) {
        if things.coins {
            for (x, y) in &self.coins {
                paint(&look.coin, (x - assets.coin_radius, y - assets.coin_radius));
            }
        }
        if let Some(exit) = self.exit.filter(|_| things.exit) {
            let picture = if exit.open { &look.exit_open } else { &look.exit_closed };
            let (x, y) = exit.location;
            paint(picture, (x - assets.exit_side / 2, y - assets.exit_side / 2));
        }
        if things.agent {
            let (sprite, corner) = look.character.picture(&self.agent);
            paint(sprite, corner);
        }
    }

    /// Paints the ground and what is hidden on it, as the light shows them.
    fn paint_light(&self, assets: &Assets, hidden: Things, canvas: &mut Canvas<'_>) {
        let dark = assets.dark(self.darkness);
        dark.ground(self.ground).paint(canvas);
        // What is black is not seen in the dark.
        if self.darkness < 255 {
            self.each(assets, dark, hidden, |sprite, (x, y)| sprite.blit(canvas, x, y));
        }
        let ground = assets.lit.ground(self.ground);
        let (columns, rows) = (canvas.columns(), canvas.rows());
        let clip = Rect::new(columns.start as i32, rows.start as i32, columns.len() as i32, rows.len() as i32);
        for circle in self.circles.iter().filter(|circle| circle.reaches(&clip)) {
            let (shape, centre) = (Shape::of(circle.radius), circle.centre());
            ground.paint_disc(canvas, &shape.disc, centre);
            self.each(assets, &assets.lit, hidden, |sprite, (x, y)| {
                sprite.blit_within(canvas, x, y, &shape.disc, centre);
            });
            if self.outlined {
                shape.draw_outline(canvas, centre, self.darkness);
            }
        }
    }
}
