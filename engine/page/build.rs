//! Compresses the files, and lists them for `include_bytes!`: the sources, and in a release build the engines if they have been built.
//! Tests do not depend on earlier builds.

use std::fmt::Write as _;
use std::io::{self, Write as _};
use std::path::PathBuf;
use std::{env, fs};

use flate2::Compression;
use flate2::write::GzEncoder;

fn main() -> io::Result<()> {
    let package = PathBuf::from(variable("CARGO_MANIFEST_DIR")?);
    let out = PathBuf::from(variable("OUT_DIR")?);
    let is_release = variable("PROFILE")? == "release";
    println!("cargo::rerun-if-changed={}", if is_release { "." } else { "files" });
    let folders = [Some("files"), is_release.then_some("built")].into_iter().flatten().map(|name| package.join(name));
    let folders = folders.filter(|folder| folder.exists()).map(fs::read_dir).collect::<io::Result<Vec<_>>>()?;
    let mut paths = folders.into_iter().flatten().map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
    paths.sort();
    let mut list = String::from("&[\n");
    for path in &paths {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let compressed = out.join(&*name);
        let mut encoder = GzEncoder::new(fs::File::create(&compressed)?, Compression::best());
        encoder.write_all(&fs::read(path)?)?;
        encoder.finish()?;
        // Formatting into a string does not fail.
        let _ = writeln!(list, "    ({name:?}, include_bytes!({compressed:?})),");
    }
    list.push_str("]\n");
    fs::write(out.join("files.rs"), list)
}

fn variable(name: &str) -> io::Result<String> {
    env::var(name).map_err(|error| io::Error::other(format!("{name}: {error}")))
}
