//! A software rasteriser that paints exactly the pixels that pygame 2.4 paints.
//!
//! The original environments draw with pygame, and their frames are the observations. So every rule here is pygame's own, with its
//! quirks: the rounding of a circle, the direction in which a wide line grows, the blending of a translucent surface by SDL.
//!
//! A [`Surface`] owns a picture; a [`Canvas`] draws into pixels that lie elsewhere, such as an observation; a [`Sprite`] and a
//! [`Disc`] are pictures compiled for fast painting. [`Damage`] collects dirty rectangles. A [`DirtySurface`] tracks its dirty
//! pixels, which a [`PixelFormat`] copies into a frame of another format.
//!
//! Pixels are RGB, column by column: the byte of channel `c` of the pixel `(x, y)` is `(x * height + y) * 3 + c`. A whole surface
//! is thus byte for byte the array `[x][y][c]` that `pygame.surfarray.array3d` returns.
//!
//! pygame takes floats for positions and sizes and truncates them towards zero. Here they are whole numbers: the caller truncates
//! (`value as i32`).
//!
//! # Stability
//!
//! [`PixelFormat`], and what a [`Task`](crate::envs::Task) draws with ([`Canvas`], [`Rect`], [`CornerRadii`], [`Rgb`], [`Surface`]), are
//! part of the crate's interface. All else is public for the benchmarks and for [`Environment`](crate::envs::Environment), and may
//! change in any version.

mod blit;
mod canvas;
mod circle;
mod damage;
mod dirty_surface;
mod format;
mod line;
mod rect;
mod rectangle;
mod runs;
mod sprite;
mod surface;
mod transform;

#[cfg(test)]
mod tests;

pub(crate) use blit::blend_keyed;
pub use canvas::Canvas;
pub(crate) use circle::circle_outline;
pub use circle::{Disc, DiscColumn};
pub use damage::Damage;
pub use dirty_surface::DirtySurface;
pub use format::PixelFormat;
pub use rect::{CornerRadii, Rect};
pub use runs::Rgb;
pub(crate) use runs::copy_run;
pub use sprite::Sprite;
pub use surface::Surface;
