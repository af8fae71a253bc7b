//! What several test programs need.
#![allow(dead_code)] // Each test program uses its own part.

use std::path::PathBuf;

/// The recorded traces of the ids that start with `prefix` and go on with `-v0`. There is no test without them: they are
/// expected in `../shared/reference`, or where `ENDLESS_REFERENCE` says.
pub fn traces(prefix: &str) -> Vec<PathBuf> {
    let reference = std::env::var_os("ENDLESS_REFERENCE")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/reference"), PathBuf::from);
    let folder = reference.join("traces");
    let entries = std::fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut files: Vec<_> = entries
        .map(|entry| entry.unwrap().path())
        .filter(|path| {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            name.starts_with(&format!("{prefix}-v0.")) && name.ends_with(".json.gz")
        })
        .collect();
    files.sort();
    assert!(!files.is_empty(), "no traces of {prefix} in {}", folder.display());
    files
}

/// The Mortar Mayhem ids without their version.
pub const MORTAR_MAYHEM: [&str; 5] =
    ["MortarMayhem", "MortarMayhem-Grid", "MortarMayhemB", "MortarMayhemB-Grid", "Endless-MortarMayhem"];
