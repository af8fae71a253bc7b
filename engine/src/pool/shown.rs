//! What each frame of a buffer shows, and how it is brought up to date.

use std::sync::Arc;

use thiserror::Error;

use crate::envs::{Environment, FRAME_BYTES, SCREEN};
use crate::raster::{Canvas, Rgb};

/// How frames are to be drawn.
#[derive(Clone, Copy, Debug)]
pub(super) struct Drawing {
    /// What is noted about the frames is so.
    pub known: bool,
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

    /// Makes a frame show the environment: what has changed is painted, or everything where nothing is known.
    pub fn update(&mut self, env: &E, drawing: Drawing, frame: &mut [u8]) -> Result<(), WrongFrame> {
        let (assets, scene) = (env.shared(), env.scene());
        let mut canvas = Canvas::new(frame, SCREEN, SCREEN);
        match &mut self.0 {
            Some((drawn_with, shown)) if drawing.known && Arc::ptr_eq(drawn_with, assets) => {
                if *shown != scene {
                    E::repaint(assets, shown, &scene, &mut canvas);
                }
                if drawing.check {
                    compare::<E>(assets, Some(shown), &scene, frame)?;
                }
                *shown = scene;
            }
            noted => {
                E::paint(assets, &scene, &mut canvas);
                if drawing.check {
                    compare::<E>(assets, None, &scene, frame)?;
                }
                *noted = Some((Arc::clone(assets), scene));
            }
        }
        Ok(())
    }
}

/// Compares a frame with one that is drawn in full.
fn compare<E: Environment>(
    assets: &E::Assets,
    shown: Option<&E::Scene>,
    scene: &E::Scene,
    frame: &[u8],
) -> Result<(), WrongFrame> {
    let mut expected = vec![0; FRAME_BYTES];
    E::paint(assets, scene, &mut Canvas::new(&mut expected, SCREEN, SCREEN));
    let (expected, found) = (expected.as_chunks::<3>().0, frame.as_chunks::<3>().0);
    match expected.iter().zip(found).position(|(expected, found)| expected != found) {
        None => Ok(()),
        Some(pixel) => Err(WrongFrame {
            env: 0,
            x: pixel / SCREEN,
            y: pixel % SCREEN,
            expected: expected[pixel],
            found: found[pixel],
            shown: shown.map_or_else(|| "nothing that is known".to_owned(), |shown| format!("{shown:?}")),
            scene: format!("{scene:?}"),
        }),
    }
}

/// A frame that was brought up to date and is not what drawing it in full gives: a mistake in this crate, or somebody has
/// changed the frame.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error(
    "the frame of environment {env} is wrong at ({x}, {y}): {found:?} instead of {expected:?}; it showed {shown}, and was to \
     show {scene}"
)]
pub struct WrongFrame {
    pub env: usize,
    /// The first pixel that differs.
    pub x: usize,
    pub y: usize,
    pub expected: Rgb,
    pub found: Rgb,
    /// What the frame showed, and what it was to show, for the crate's developers.
    pub shown: String,
    pub scene: String,
}
