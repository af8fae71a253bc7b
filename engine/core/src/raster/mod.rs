//! Software drawing that paints exactly the pixels that pygame 2.4 paints.
//!
//! The environments were drawn with pygame, and what they drew is the observation. So every rule
//! here is pygame's own, with its quirks: how it rounds a circle, which way a wide line grows, how
//! SDL mixes a translucent surface into another one.
//!
//! A picture is built on a [`Surface`]; a [`Canvas`] draws into pixels that lie elsewhere, such as
//! an observation; a [`Sprite`] and a [`Disc`] are pictures made ready to be painted quickly. A
//! [`Sketch`] remembers what was painted on it, and a [`PixelFormat`] carries that to where the
//! pixels are to lie in another order, or as grey.
//!
//! Pixels are RGB, column by column: the byte of channel `c` of the pixel `(x, y)` is
//! `(x * height + y) * 3 + c`. A whole surface is thus byte for byte the array `[x][y][c]` that
//! `pygame.surfarray.array3d` gives.
//!
//! pygame takes floats for positions and sizes and cuts off their fractions, towards zero. Here
//! they are whole numbers: the caller truncates (`value as i32`).

mod blit;
mod canvas;
mod circle;
mod damage;
mod format;
mod line;
mod rectangle;
mod rotate;
mod scale;
mod sketch;
mod sprite;
mod surface;

#[cfg(test)]
mod tests;

pub use blit::{blend_keyed, blend_plain};
pub use canvas::Canvas;
pub use circle::{Disc, DiscColumn, circle_outline};
pub use damage::Damage;
pub use format::PixelFormat;
pub use rectangle::{CornerRadii, Rect};
pub use sketch::Sketch;
pub use sprite::{Sprite, copy_run};
pub use surface::Surface;

/// A colour: red, green, blue.
pub type Rgb = [u8; 3];
