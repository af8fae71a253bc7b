//! A picture with the colour key and the alpha of a pygame surface.

use super::canvas::Canvas;
use super::rect::{CornerRadii, Rect};
use super::runs::Rgb;

/// An RGB picture, like a `pygame.Surface` in the display's format: 32 bits, no per-pixel alpha.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Surface {
    width: usize,
    height: usize,
    pixels: Vec<u8>,
    color_key: Option<Rgb>,
    alpha: u8,
    /// Whether SDL would store the picture run-length encoded, which changes how it is blended.
    pub(super) run_length_encoded: bool,
}

impl Surface {
    /// A black, opaque surface without a colour key.
    ///
    /// # Panics
    ///
    /// If the size in bytes overflows `usize`.
    pub fn new(width: usize, height: usize) -> Self {
        let size = width.checked_mul(height).and_then(|pixels| pixels.checked_mul(3));
        Self {
            width,
            height,
            pixels: vec![0; size.expect("the size of a surface in bytes")],
            color_key: None,
            alpha: 255,
            run_length_encoded: false,
        }
    }

    /// A black surface of another size, with the attributes of pygame's transformations of this one: the same colour key and
    /// alpha, and run-length encoded if there is a colour key.
    pub(super) fn transformed(&self, width: usize, height: usize) -> Self {
        Self {
            color_key: self.color_key,
            alpha: self.alpha,
            run_length_encoded: self.color_key.is_some(),
            ..Self::new(width, height)
        }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// The bytes, column by column, 3 per pixel.
    pub fn pixels(&self) -> &[u8] {
        &self.pixels
    }

    /// The bytes, mutably.
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        &mut self.pixels
    }

    /// Returns the bytes.
    pub fn into_pixels(self) -> Vec<u8> {
        self.pixels
    }

    /// The colour of a pixel, or `None` outside the surface.
    pub fn pixel(&self, x: usize, y: usize) -> Option<Rgb> {
        if x >= self.width || y >= self.height {
            return None;
        }
        self.pixels.as_chunks().0.get(x * self.height + y).copied()
    }

    /// The colour that a blit of the surface leaves out.
    pub fn color_key(&self) -> Option<Rgb> {
        self.color_key
    }

    /// Sets or removes the colour key.
    pub fn set_color_key(&mut self, color_key: Option<Rgb>) {
        self.color_key = color_key;
        // pygame drops the encoding whenever it sets a key, but not when it removes one.
        self.run_length_encoded &= color_key.is_none();
    }

    /// The opacity in a blit of the surface, from 0 (transparent) to 255 (opaque).
    pub fn alpha(&self) -> u8 {
        self.alpha
    }

    /// Sets the alpha, clamped to 0 to 255.
    pub fn set_alpha(&mut self, alpha: i32) {
        self.alpha = alpha.clamp(0, 255) as u8;
        self.run_length_encoded = false;
    }

    /// The surface as a canvas.
    pub fn canvas(&mut self) -> Canvas<'_> {
        Canvas::new(&mut self.pixels, self.width, self.height)
    }

    /// Paints every pixel.
    pub fn fill(&mut self, color: Rgb) {
        self.canvas().fill(color);
    }

    /// Draws a circle: see [`Canvas::draw_circle`].
    pub fn draw_circle(&mut self, color: Rgb, center: (i32, i32), radius: i32, width: i32) {
        self.canvas().draw_circle(color, center, radius, width);
    }

    /// Draws a line: see [`Canvas::draw_line`].
    pub fn draw_line(&mut self, color: Rgb, start: (i32, i32), end: (i32, i32), width: i32) {
        self.canvas().draw_line(color, start, end, width);
    }

    /// Draws a rectangle: see [`Canvas::draw_rect`].
    pub fn draw_rect(&mut self, color: Rgb, rect: Rect, width: i32) {
        self.canvas().draw_rect(color, rect, width);
    }

    /// Draws a rectangle with rounded corners: see [`Canvas::draw_rounded_rect`].
    pub fn draw_rounded_rect(&mut self, color: Rgb, rect: Rect, width: i32, radii: CornerRadii) {
        self.canvas().draw_rounded_rect(color, rect, width, radii);
    }

    /// Blits `source` with its top left corner at `(x, y)`: see [`Canvas::blit`].
    pub fn blit(&mut self, source: &Surface, x: i32, y: i32) {
        self.canvas().blit(source, x, y);
    }
}
