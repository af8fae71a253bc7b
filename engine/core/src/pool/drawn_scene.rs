//! Tracks the scene that was last drawn into each frame of a buffer, and updates the frame to another scene.

use std::cell::{Cell, RefCell};
use std::sync::Arc;

use thiserror::Error;

use crate::batch::Frames;
use crate::envs::{EnvSpec, Environment};
use crate::raster::{Canvas, DirtySurface, FrameShape, PixelFormat};

/// Settings for drawing frames.
#[derive(Clone, Copy, Debug)]
pub(super) struct DrawSettings {
    /// Whether the buffer still holds the pool's last write, so that its frames show the drawn scenes.
    pub current: bool,
    pub frame: FrameFormat,
    /// Whether to compare every frame with the same frame drawn in full.
    pub check: bool,
}

/// Size and format of the frames of a pool.
#[derive(Clone, Copy, Debug)]
pub(super) struct FrameFormat {
    pub shape: FrameShape,
    pub format: PixelFormat,
}

impl FrameFormat {
    /// The frames of a pool. Without frames, they are empty.
    pub fn new(spec: &EnvSpec, frames: Option<Frames>) -> Self {
        let shape = spec.frame.unwrap_or(FrameShape::rgb(0, 0));
        FrameFormat { shape, format: frames.unwrap_or_default().format }
    }

    /// The pictures for people, in the default format.
    pub fn shown(spec: &EnvSpec) -> Option<Self> {
        Some(FrameFormat { shape: spec.shown()?, format: PixelFormat::default() })
    }

    /// Bytes of a frame.
    pub fn bytes(self) -> usize {
        self.format.shape(self.shape).iter().product()
    }

    /// Whether a frame can be changed without painting it in full.
    fn can_repaint(self) -> bool {
        self.shape.channels == 3 && (self.format.is_canvas() || self.shape.height <= DirtySurface::MAX_HEIGHT)
    }
}

/// The scene that was last drawn into a frame, with its assets; `None` before the first.
#[derive(Debug)]
pub(super) struct DrawnScene<E: Environment>(Option<(Arc<E::Assets>, E::Scene)>);

impl<E: Environment> DrawnScene<E> {
    /// Nothing was drawn yet.
    pub fn unknown() -> Self {
        DrawnScene(None)
    }

    /// Updates `frame` to `scene`: repaints what differs from the drawn scene, or draws in full if the frame's content is
    /// unknown or was drawn with other assets.
    pub fn update(
        &mut self,
        assets: &Arc<E::Assets>,
        mut scene: E::Scene,
        settings: DrawSettings,
        frame: &mut [u8],
    ) -> Result<(), WrongFrame> {
        match &mut self.0 {
            Some((drawn_with, drawn)) if settings.current && Arc::ptr_eq(drawn_with, assets) => {
                if *drawn != scene {
                    if settings.frame.can_repaint() {
                        paint_on(frame, settings.frame, |canvas| E::repaint(assets, drawn, &scene, canvas));
                    } else {
                        draw_in_full::<E>(assets, &scene, settings.frame, frame);
                    }
                }
                if settings.check {
                    compare::<E>(assets, Some(drawn), &scene, settings.frame, frame)?;
                }
                // Faster than an assignment, which calls memcpy for a large scene.
                std::mem::swap(drawn, &mut scene);
            }
            drawn => {
                draw_in_full::<E>(assets, &scene, settings.frame, frame);
                if settings.check {
                    compare::<E>(assets, None, &scene, settings.frame, frame)?;
                }
                *drawn = Some((Arc::clone(assets), scene));
            }
        }
        Ok(())
    }
}

/// Draws a frame in full.
pub(super) fn draw_in_full<E: Environment>(
    assets: &E::Assets,
    scene: &E::Scene,
    format: FrameFormat,
    frame: &mut [u8],
) {
    let FrameFormat { shape, format: order } = format;
    if shape.channels == 3 {
        return paint_on(frame, format, |canvas| E::paint(assets, scene, canvas));
    }
    if order.is_canvas() {
        frame.fill(0);
        return E::write_pixels(assets, scene, frame);
    }
    let mut pixels = PIXELS.take();
    pixels.clear();
    pixels.resize(shape.bytes(), 0);
    E::write_pixels(assets, scene, &mut pixels);
    order.copy(shape, &pixels, frame);
    PIXELS.set(pixels);
}

thread_local! {
    /// The surface for frames in a format that a canvas cannot paint directly.
    static SURFACE: RefCell<DirtySurface> = RefCell::new(DirtySurface::new(0, 0));
    /// The same for frames that are no canvas because of their channels.
    static PIXELS: Cell<Vec<u8>> = const { Cell::new(Vec::new()) };
}

/// Calls `paint` with a canvas for `frame`. Only painted pixels change.
fn paint_on(frame: &mut [u8], FrameFormat { shape, format }: FrameFormat, paint: impl FnOnce(&mut Canvas<'_>)) {
    if format.is_canvas() {
        return paint(&mut Canvas::new(frame, shape.width, shape.height));
    }
    SURFACE.with_borrow_mut(|surface| {
        if (surface.width(), surface.height()) != (shape.width, shape.height) {
            *surface = DirtySurface::new(shape.width, shape.height);
        }
        paint(&mut surface.canvas());
        format.store(surface, frame);
    });
}

/// Compares a frame with the same frame drawn in full.
fn compare<E: Environment>(
    assets: &E::Assets,
    drawn: Option<&E::Scene>,
    scene: &E::Scene,
    format: FrameFormat,
    frame: &[u8],
) -> Result<(), WrongFrame> {
    let mut expected = vec![0; frame.len()];
    draw_in_full::<E>(assets, scene, format, &mut expected);
    // The tests compare every frame, and `position` alone is slow in their builds.
    if expected == frame {
        return Ok(());
    }
    let byte = expected.iter().zip(frame).position(|(expected, found)| expected != found).unwrap_or_default();
    Err(WrongFrame {
        env: 0,
        pixel: format.format.pixel_of(byte, format.shape),
        expected: expected[byte],
        found: frame[byte],
        before: drawn.map_or_else(|| "unknown".to_owned(), |drawn| format!("{drawn:?}")),
        scene: format!("{scene:?}"),
    })
}

/// An updated frame differs from the same frame drawn in full: a bug in this crate, or the frame was changed without a call to
/// [`Layout::forget_frames`](crate::batch::Layout::forget_frames).
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error(
    "the frame of environment {env} is wrong at pixel {pixel:?}: expected {expected}, found {found}; its scene was {before}, and \
     is {scene}"
)]
pub struct WrongFrame {
    /// Number of the environment.
    pub env: usize,
    /// (x, y) of the first pixel that differs.
    pub pixel: (usize, usize),
    /// The byte of the frame drawn in full.
    pub expected: u8,
    /// The byte of the updated frame.
    pub found: u8,
    /// The scene that the frame showed before, or `unknown`, formatted with `Debug`.
    pub before: String,
    /// The scene that the frame should show, formatted with `Debug`.
    pub scene: String,
}
