//! Local web pages: [`PlayServer`] serves the page that plays the environments, and [`ViewServer`] a page that shows
//! the environments of a running engine while a trainer steps them.
//!
//! Both listen only on 127.0.0.1, and refuse requests that name another host or come from another site's page. The
//! address of a [`ViewServer`] contains a random token, which every request needs.

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
