//! Web pages on this machine alone: [`PlayServer`] serves the page on which the environments are played, and [`ViewServer`]
//! a page that shows the environments of a running engine while a trainer steps them.
//!
//! Both listen on 127.0.0.1 only, and refuse requests that name another host or that come from the page of another site.
//! The address of a [`ViewServer`] contains a random token, without which nothing is answered.

#![deny(unsafe_code)]

mod channel;
mod engines;
mod error;
mod local;
mod message;
mod play;
mod statistics;
mod view;
mod watched_group;
mod watcher;

pub use error::ViewError;
pub use play::PlayServer;
pub use statistics::RecentEpisodes;
pub use view::ViewServer;
