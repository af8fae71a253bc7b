//! The page that plays the environments in a browser, in target/web: the core as WebAssembly, and the files of
//! `engine/view/page/files`.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use flate2::Compression;
use flate2::write::GzEncoder;

use crate::cargo;
use crate::venv::{execute, target, workspace};
use crate::wasm::Toolchain;

/// Bytes of all files, each compressed: what a browser downloads at most.
const LIMIT: usize = 1_000_000;

/// The file that the build completes: the list of the others, and a number that changes with them.
const WORKER: &str = "worker.js";

/// Where the page is built.
pub fn folder() -> Result<PathBuf, String> {
    Ok(target()?.join("web"))
}

/// Builds the page.
///
/// # Errors
///
/// If there is no compiler for WebAssembly, or if the page has become too large.
pub fn build() -> Result<(), String> {
    println!("==> page");
    let toolchain = Toolchain::find().ok_or_else(Toolchain::missing)?;
    execute(toolchain.build()?.args(["--release", "--package", "endless-gym-web"]))?;
    let mut files = vec![("engine.wasm".to_owned(), read(&toolchain.output()?.join("release/endless_gym_web.wasm"))?)];
    let page = workspace().join("engine/view/page/files");
    let entries = fs::read_dir(&page).map_err(|error| describe(&page, &error))?;
    for entry in entries {
        let path = entry.map_err(|error| describe(&page, &error))?.path();
        files.push((path.file_name().unwrap_or_default().to_string_lossy().into_owned(), read(&path)?));
    }
    files.sort();
    complete_worker(&mut files)?;
    write(&folder()?, &files)?;
    // From where the program embeds it. Unchanged files are left alone, so that it need not be compiled again.
    let embedded = workspace().join("engine/view/page/built");
    if files.iter().any(|(name, bytes)| fs::read(embedded.join(name)).ok().as_ref() != Some(bytes)) {
        write(&embedded, &files)?;
    }
    let compressed = files.iter().map(|(_, bytes)| compressed(bytes)).sum::<usize>();
    println!("    {} files, {compressed} bytes compressed, {}", files.len(), folder()?.join("index.html").display());
    if compressed > LIMIT {
        return Err(format!("the page must be at most {LIMIT} bytes compressed, got {compressed}"));
    }
    Ok(())
}

/// Builds the page that plays, and tests it and the page of a running engine in a browser.
pub fn test() -> Result<(), String> {
    build()?;
    // Not what only measures or makes pictures.
    let tests = ["--ignored", "--test-threads", "1", "--skip", "measure"];
    cargo::run(
        &[&["test", "--locked", "--package", "endless-gym-web", "--test", "browser", "--"], tests.as_slice()].concat(),
    )?;
    cargo::run(&[&["test", "--locked", "--test", "integration", "--"], tests.as_slice(), &["browser::"]].concat())
}

/// Writes the list of files, and a checksum of them all, into the service worker, which keeps them for use without a network.
fn complete_worker(files: &mut [(String, Vec<u8>)]) -> Result<(), String> {
    let mut checksum = flate2::Crc::new();
    files.iter().for_each(|(_, bytes)| checksum.update(bytes));
    let names: Vec<&str> = files.iter().map(|(name, _)| name.as_str()).filter(|name| *name != WORKER).collect();
    let lines = format!("const VERSION = \"{:08x}\";\nconst FILES = {};\n", checksum.sum(), serde_json::json!(names));
    let (_, worker) =
        files.iter_mut().find(|(name, _)| name == WORKER).ok_or_else(|| format!("{WORKER} is missing"))?;
    worker.splice(0..0, lines.into_bytes());
    Ok(())
}

fn write(folder: &Path, files: &[(String, Vec<u8>)]) -> Result<(), String> {
    if folder.exists() {
        fs::remove_dir_all(folder).map_err(|error| describe(folder, &error))?;
    }
    fs::create_dir_all(folder).map_err(|error| describe(folder, &error))?;
    files.iter().try_for_each(|(name, bytes)| {
        let path = folder.join(name);
        fs::write(&path, bytes).map_err(|error| describe(&path, &error))
    })
}

fn compressed(bytes: &[u8]) -> usize {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
    // Writing to memory does not fail.
    let written = encoder.write_all(bytes).and_then(|()| encoder.finish());
    written.map_or(bytes.len(), |bytes| bytes.len())
}

fn read(path: &Path) -> Result<Vec<u8>, String> {
    fs::read(path).map_err(|error| describe(path, &error))
}

fn describe(path: &Path, error: &std::io::Error) -> String {
    format!("{}: {error}", path.display())
}
