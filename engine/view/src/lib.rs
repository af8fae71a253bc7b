//! Web servers that watch a running engine: [`ViewServer`] serves a page that shows its environments while a trainer steps
//! them, and [`MetricsServer`] its metrics.
//!
//! The page is served only on 127.0.0.1. Its address contains a random token, which every request needs.

#![deny(unsafe_code)]

mod channel;
mod engines;
mod message;
mod metrics;
mod statistics;
mod view;
mod watched_group;
mod watcher;

pub use metrics::MetricsServer;
pub use statistics::{RecentEpisodes, RecentRate};
pub use view::ViewServer;
