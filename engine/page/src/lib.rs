//! The files of the web page that plays environments, for programs that serve or write it.
//!
//! `cargo xtask web` builds the engines with the environments of Memory Gym and of POPGym as WebAssembly into this package's folder
//! `built`. Later release builds of this crate contain them. Other builds contain only the other files.
//!
//! With the feature `server`, [`PlayServer`] serves the page, and [`server`] has what other web servers of a program share
//! with it. They listen on 127.0.0.1 or where the user says, refuse requests that come from another site's page and, on an
//! address of this host only, those that name another host. Each has a limited number of connections and threads.

#![deny(unsafe_code)]

#[cfg(feature = "server")]
mod error;
mod files;
#[cfg(feature = "server")]
mod play;
#[cfg(feature = "server")]
pub mod server;

#[cfg(feature = "server")]
pub use error::ServerError;
pub use files::{ENGINES, FILES, decompress, file, files};
#[cfg(feature = "server")]
pub use play::PlayServer;
