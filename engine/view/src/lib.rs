//! Web servers: [`PlayServer`] serves the page that plays the environments, [`ViewServer`] a page that shows the
//! environments of a running engine while a trainer steps them, and [`MetricsServer`] an engine's metrics.
//!
//! The pages are served only on 127.0.0.1. All servers refuse requests that come from another site's page; on an
//! address of this host only, also those that name another host. The address of a [`ViewServer`] contains a random
//! token, which every request needs. Each server has a limited number of connections and threads, whatever clients do.

#![deny(unsafe_code)]

mod channel;
mod engines;
mod error;
mod message;
mod metrics;
mod play;
mod server;
mod statistics;
mod view;
mod watched_group;
mod watcher;

pub use error::ViewError;
pub use metrics::MetricsServer;
pub use play::PlayServer;
pub use statistics::{RecentEpisodes, RecentRate};
pub use view::ViewServer;
