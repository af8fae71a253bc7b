//! The commands, one in each file.

pub mod bench;
pub mod check;
pub mod demo;
pub mod learn;
pub mod list;
pub mod new;
pub mod page;
pub mod play;
pub mod record;
pub mod scaling;
pub mod serve;
pub mod status;
pub mod verify;
pub mod view;
