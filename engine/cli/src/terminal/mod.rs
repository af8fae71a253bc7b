//! Playing and watching in a terminal.

mod frame;
mod game;
mod keys;
mod picture;
pub mod play;
mod screen;
mod status;
pub mod view;
