//! The files of the web page that plays the environments, for programs that serve it.
//!
//! `cargo xtask web` builds the page, with the engine as WebAssembly, into this package's folder `built`. Later release
//! builds of this crate contain it. Other builds contain only the page's sources, from which other pages take style and
//! icon.

/// Names and contents of the files.
pub const FILES: &[(&str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/files.rs"));

/// The file of that name, such as `index.html`.
///
/// ```
/// assert!(endless_gym_page::file("index.html").is_some());
/// assert!(endless_gym_page::file("../Cargo.toml").is_none());
/// ```
pub fn file(name: &str) -> Option<&'static [u8]> {
    FILES.iter().find_map(|(other, bytes)| (*other == name).then_some(*bytes))
}

/// Whether the page was built before this crate and so can be played.
pub fn is_built() -> bool {
    file("engine.wasm").is_some()
}
