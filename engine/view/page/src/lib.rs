//! The files of the page on which the environments are played in a browser, for a program that serves them.
//!
//! `cargo xtask web` builds the page into this package's folder `built`, with the engine as WebAssembly. Release builds of this crate
//! after that contain it. Others contain the sources of the page alone, which other pages share: style, icon, modules.

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

/// Whether the page can be played: whether it was built before this crate.
pub fn is_built() -> bool {
    file("engine.wasm").is_some()
}
