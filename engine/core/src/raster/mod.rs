//! A software rasteriser that paints exactly the pixels that pygame 2.4 paints.
//!
//! The original environments draw with pygame, and their frames are the observations. So this module follows pygame, including
//! its quirks: how a circle is rounded, to which side a wide line grows, and how SDL blends a translucent surface.
//!
//! A [`Surface`] owns a picture; a [`Canvas`] draws into borrowed pixels, such as an observation; a [`Sprite`] and a [`Disc`]
//! are pictures compiled for fast painting. [`Damage`] collects dirty rectangles. A [`DirtySurface`] tracks its dirty pixels,
//! which a [`PixelFormat`] copies into a frame of another format.
//!
//! Pixels are RGB, column by column: channel `c` of the pixel `(x, y)` is at byte `(x * height + y) * 3 + c`. The bytes of a
//! surface thus equal the array `[x][y][c]` that `pygame.surfarray.array3d` returns.
//!
//! pygame takes floats for positions and sizes and truncates them towards zero. Here they are integers: the caller truncates
//! (`value as i32`).
//!
//! # Stability
//!
//! [`PixelFormat`] and the types that a [`Task`](crate::envs::Task) draws with ([`Canvas`], [`Rect`], [`CornerRadii`], [`Rgb`],
//! [`Surface`]) are part of the crate's interface. Everything else is public for the benchmarks and for
//! [`Environment`](crate::envs::Environment), and may change in any version.

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

pub use blit::blend_keyed;
pub use canvas::Canvas;
pub use circle::{Disc, DiscColumn, circle_outline};
pub use damage::Damage;
pub use dirty_surface::DirtySurface;
pub use format::{FrameShape, PixelFormat};
pub use rect::{CornerRadii, Rect};
pub use runs::{Rgb, copy_run};
pub use sprite::Sprite;
pub use surface::Surface;
