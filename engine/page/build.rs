//! Compresses the files, and lists them for `include_bytes!`: the sources, and in a release build the engine if it has been built.
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
    let (engine, files) = (package.join("built/engine.wasm"), package.join("files"));
    let is_release = variable("PROFILE")? == "release";
    println!("cargo::rerun-if-changed={}", if is_release { "." } else { "files" });
    let mut paths: Vec<PathBuf> = fs::read_dir(files)?.map(|entry| Ok(entry?.path())).collect::<io::Result<_>>()?;
    paths.extend(Some(engine).filter(|engine| is_release && engine.exists()));
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
