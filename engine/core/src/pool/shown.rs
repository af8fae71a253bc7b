//! What each frame of a buffer shows, and how it is brought up to date.

use std::cell::RefCell;
use std::sync::Arc;

use thiserror::Error;

use crate::envs::{Environment, SCREEN};
use crate::raster::{Canvas, PixelFormat, Sketch};

/// How frames are to be drawn.
#[derive(Clone, Copy, Debug)]
pub(super) struct Drawing {
    /// What is noted about the frames is so.
    pub known: bool,
    pub format: PixelFormat,
    /// Every frame is compared with one that is drawn in full.
    pub check: bool,
}

/// What is noted about one frame.
#[derive(Debug)]
pub(super) struct Shown<E: Environment>(Option<(Arc<E::Assets>, E::Scene)>);

impl<E: Environment> Shown<E> {
    /// Nothing is known about the frame.
    pub fn nothing() -> Self {
        Shown(None)
    }

    /// Makes a frame show a scene: what has changed is painted, or everything where nothing is known.
    pub fn update(
        &mut self,
        assets: &Arc<E::Assets>,
        scene: E::Scene,
        drawing: Drawing,
        frame: &mut [u8],
    ) -> Result<(), WrongFrame> {
        match &mut self.0 {
            Some((drawn_with, shown)) if drawing.known && Arc::ptr_eq(drawn_with, assets) => {
                if *shown != scene {
                    paint_on(frame, drawing.format, |canvas| E::repaint(assets, shown, &scene, canvas));
                }
                if drawing.check {
                    compare::<E>(assets, Some(shown), &scene, drawing.format, frame)?;
                }
                *shown = scene;
            }
            noted => {
                draw::<E>(assets, &scene, drawing.format, frame);
                if drawing.check {
                    compare::<E>(assets, None, &scene, drawing.format, frame)?;
                }
                *noted = Some((Arc::clone(assets), scene));
            }
        }
        Ok(())
    }
}

/// Draws a frame in full.
pub(super) fn draw<E: Environment>(assets: &E::Assets, scene: &E::Scene, format: PixelFormat, frame: &mut [u8]) {
    paint_on(frame, format, |canvas| E::paint(assets, scene, canvas));
}

thread_local! {
    /// Where frames are painted that no canvas can lie on.
    static SKETCH: RefCell<Sketch> = RefCell::new(Sketch::new(SCREEN, SCREEN));
}

/// Has something painted on a frame of some format. What is painted is all that changes.
fn paint_on(frame: &mut [u8], format: PixelFormat, paint: impl FnOnce(&mut Canvas<'_>)) {
    if format.is_canvas() {
        return paint(&mut Canvas::new(frame, SCREEN, SCREEN));
    }
    SKETCH.with_borrow_mut(|sketch| {
        paint(&mut sketch.canvas());
        format.store(sketch, frame);
    });
}

/// Compares a frame with one that is drawn in full.
fn compare<E: Environment>(
    assets: &E::Assets,
    shown: Option<&E::Scene>,
    scene: &E::Scene,
    format: PixelFormat,
    frame: &[u8],
) -> Result<(), WrongFrame> {
    let mut expected = vec![0; frame.len()];
    draw::<E>(assets, scene, format, &mut expected);
    match expected.iter().zip(frame).position(|(expected, found)| expected != found) {
        None => Ok(()),
        Some(byte) => Err(WrongFrame {
            env: 0,
            place: format.place(byte, SCREEN, SCREEN),
            expected: expected[byte],
            found: frame[byte],
            shown: shown.map_or_else(|| "nothing that is known".to_owned(), |shown| format!("{shown:?}")),
            scene: format!("{scene:?}"),
        }),
    }
}

/// A frame that was brought up to date and is not what drawing it in full gives: a mistake in this crate, or somebody has
/// changed the frame.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error(
    "the frame of environment {env} is wrong at {place:?}: {found} instead of {expected}; it showed {shown}, and was to show \
     {scene}"
)]
pub struct WrongFrame {
    pub env: usize,
    /// (x, y) of the first pixel that differs, and what it has there.
    pub place: (usize, usize),
    pub expected: u8,
    pub found: u8,
    /// What the frame showed, and what it was to show, for the crate's developers.
    pub shown: String,
    pub scene: String,
}
