//! The files of the page.

use std::io::Read;

use flate2::read::GzDecoder;

/// Names and contents of the files, each compressed with gzip.
pub const FILES: &[(&str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/files.rs"));

/// The engine of the page, with the environments of Memory Gym or of a crate, and that of the page at `?popgym`.
pub const ENGINES: [&str; 2] = ["engine.wasm", "popgym.wasm"];

/// The service worker, which lacks the list of the files that it caches.
const WORKER: &str = "worker.js";

/// The end of the name of a trained agent's file, after the id of its environment, and what comes before it for one without memory.
const AGENT: &str = ".safetensors";
const NO_MEMORY: &str = "-none";

/// The file of that name, such as `index.html`, compressed with gzip.
///
/// ```
/// let file = endless_gym_page::file("index.html").unwrap();
/// assert!(endless_gym_page::decompress(file).starts_with(b"<!doctype html>"));
/// assert!(endless_gym_page::file("../Cargo.toml").is_none());
/// ```
pub fn file(name: &str) -> Option<&'static [u8]> {
    FILES.iter().find_map(|(other, bytes)| (*other == name).then_some(*bytes))
}

/// The contents of one of the compressed files; empty for other bytes.
pub fn decompress(file: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    // Reading from memory fails only for bytes that were not compressed.
    GzDecoder::new(file).read_to_end(&mut bytes).map_or_else(|_| Vec::new(), |_| bytes)
}

/// Names and contents of all files of a page with these engines by their names, for any web server. `has_id` says whether they have
/// an environment: agents of others are left out.
///
/// ```
/// let files = endless_gym_page::files(&[("engine.wasm", b"\0asm")], |_| false);
/// let (_, worker) = files.iter().find(|(name, _)| *name == "worker.js").unwrap();
/// assert!(worker.starts_with(b"const VERSION = \""));
/// ```
pub fn files(engines: &[(&'static str, &[u8])], has_id: impl Fn(&str) -> bool) -> Vec<(&'static str, Vec<u8>)> {
    let is_kept = |name: &str| {
        !ENGINES.contains(&name)
            && name.strip_suffix(AGENT).is_none_or(|agent| has_id(agent.strip_suffix(NO_MEMORY).unwrap_or(agent)))
    };
    let sources = FILES.iter().filter(|(name, _)| is_kept(name)).map(|(name, bytes)| (*name, decompress(bytes)));
    let mut files: Vec<_> = sources.chain(engines.iter().map(|(name, engine)| (*name, engine.to_vec()))).collect();
    let mut checksum = crc32fast::Hasher::new();
    files.iter().for_each(|(_, bytes)| checksum.update(bytes));
    let names: Vec<&str> = files.iter().map(|(name, _)| *name).filter(|name| *name != WORKER).collect();
    let lines = format!("const VERSION = \"{:08x}\";\nconst FILES = {names:?};\n", checksum.finalize());
    for (_, worker) in files.iter_mut().filter(|(name, _)| *name == WORKER) {
        worker.splice(0..0, lines.bytes());
    }
    files
}

#[cfg(test)]
#[test]
fn the_page_offers_the_agents_whose_files_it_has() {
    use std::collections::BTreeSet;

    let script = String::from_utf8(decompress(file("agents.js").unwrap())).unwrap();
    let table = script.split_once("const MINUTES = {").unwrap().1.split_once('}').unwrap().0;
    let offered: BTreeSet<&str> = table.split('"').skip(1).step_by(2).collect();
    let found: BTreeSet<&str> = FILES.iter().filter_map(|(name, _)| name.strip_suffix(AGENT)).collect();
    assert_eq!(offered, found);
}
