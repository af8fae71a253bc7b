//! Playing and watching in a terminal.

mod controls;
mod frame;
mod game;
mod keys;
pub mod picture;
pub mod play;
mod screen;
mod status;
pub mod view;
