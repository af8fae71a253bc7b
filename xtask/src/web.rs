//! Builds the core for WebAssembly, and in target/web the page that plays the environments in a browser, from the core
//! and the files of `engine/page/files`.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

use endless_gym_page::ENGINES;
use flate2::Compression;
use flate2::read::GzEncoder;

use crate::shell::{cargo, describe, has, output, recreate, remap, run, target, workspace};

const TARGET: &str = "wasm32-unknown-unknown";

/// What to install if there is no toolchain.
pub const MISSING: &str = "Rust's standard library for wasm32-unknown-unknown; rustup target add wasm32-unknown-unknown, or on Debian \
    .ci/wasm-toolchain, which unpacks Debian's compiler under target/";

/// Limit of the bytes of all compressed files that a browser downloads at first: not those of POPGym, nor agents that the landing does
/// not show.
const LIMIT: u64 = 620_000;

/// A compiler with the target's standard library, or with its sources.
pub enum Toolchain {
    /// The compiler on the path.
    Own,
    /// Debian's compiler in the folder where `.ci/wasm-toolchain` unpacks it. Debian has no compiled standard library for it.
    Debian(PathBuf),
}

impl Toolchain {
    pub fn find() -> Option<Self> {
        let libraries = output(Command::new("rustc").args(["--print", "target-libdir", "--target", TARGET]));
        if libraries.is_ok_and(|folder| Path::new(folder.trim()).is_dir()) {
            return Some(Toolchain::Own);
        }
        let folder = target().ok()?.join("wasm-toolchain/usr");
        folder.join("bin/rustc").exists().then_some(Toolchain::Debian(folder))
    }

    /// Sets the variables with which cargo, or a command that runs it, builds with this compiler, and returns the target directory.
    fn set(&self, command: &mut Command) -> Result<PathBuf, String> {
        let mut built = target()?;
        if let Toolchain::Debian(folder) = self {
            // A separate folder, so that the two compilers do not invalidate each other's builds.
            built.push("wasm");
            command.env("CARGO_UNSTABLE_BUILD_STD", "std,panic_abort").env("CARGO_TARGET_DIR", &built);
            command.env("RUSTC", folder.join("bin/rustc")).env("RUSTC_BOOTSTRAP", "1");
            let libraries = format!("lib/{}-linux-gnu", std::env::consts::ARCH);
            for (variable, first) in
                [("PATH", ["bin", "lib/llvm/bin"]), ("LD_LIBRARY_PATH", [&libraries, "lib/llvm/lib"])]
            {
                let before = std::env::var_os(variable).unwrap_or_default();
                let before = std::env::split_paths(&before).filter(|path| !path.as_os_str().is_empty());
                let all = first.iter().map(|path| folder.join(path)).chain(before);
                command.env(variable, std::env::join_paths(all).map_err(|error| format!("{variable}: {error}"))?);
            }
        }
        Ok(built)
    }
}

/// Whether there is a Chromium for the tests.
pub fn has_browser() -> bool {
    let given = std::env::var("CHROMIUM").into_iter();
    let mut programs = given.chain(["chromium", "chromium-browser", "google-chrome"].map(str::to_owned));
    programs.any(|program| has(&program))
}

/// Where the page is built.
pub fn folder() -> Result<PathBuf, String> {
    Ok(target()?.join("web"))
}

/// Builds the page. Fails if there is no compiler for WebAssembly, or if the page is too large.
pub fn build() -> Result<(), String> {
    let [memory_gym, popgym] = [engine("memory-gym")?, engine("popgym")?];
    let engines: Vec<_> = ENGINES.into_iter().zip([&*memory_gym, &*popgym]).collect();
    let files = endless_gym_page::files(&engines, |_| true);
    write(&folder()?, &files)?;
    let embedded = embedded();
    // They are not rewritten unchanged, to avoid a rebuild.
    if engines.iter().any(|(name, engine)| !fs::read(embedded.join(name)).is_ok_and(|bytes| bytes == *engine)) {
        write(&embedded, &engines)?;
    }
    // Reading from memory does not fail.
    let compress = |bytes: &[u8]| io::copy(&mut GzEncoder::new(bytes, Compression::default()), &mut io::sink());
    // Agents are loaded when they are chosen, except for those of the landing, whose environment app.js names.
    let app = files.iter().find(|(name, _)| *name == "app.js").map(|(_, bytes)| String::from_utf8_lossy(bytes));
    let is_named = |id: &str| app.as_ref().is_some_and(|app| app.contains(&format!("\"{id}\"")));
    let is_landing = |agent: &str| is_named(agent.trim_end_matches("-none"));
    let is_first = |name: &str| name != ENGINES[1] && name.strip_suffix(".safetensors").is_none_or(is_landing);
    let first = files.iter().filter(|(name, _)| is_first(name));
    let compressed: u64 = first.flat_map(|(_, bytes)| compress(bytes)).sum();
    let index = folder()?.join("index.html");
    println!("    {} files, at first {compressed} bytes compressed, {}", files.len(), index.display());
    if compressed > LIMIT {
        return Err(format!("the page must be at most {LIMIT} bytes compressed, got {compressed}"));
    }
    Ok(())
}

/// Builds the engine with the environments of a suite.
fn engine(suite: &str) -> Result<Vec<u8>, String> {
    // With a `cdylib` in the manifest, cargo would build one for every crate that depends on the library, under the same name.
    let package = ["rustc", "--locked", "--release", "--package", "endless-gym-web", "--lib", "--crate-type", "cdylib"];
    let mut cargo = cargo(&package);
    cargo.args(["--no-default-features", "--features", suite, "--target", TARGET]);
    // Browsers download the result, and programs embed it, so strip symbols, line numbers and local paths.
    cargo.env("CARGO_ENCODED_RUSTFLAGS", remap(workspace())?);
    cargo.env("CARGO_PROFILE_RELEASE_DEBUG", "false").env("CARGO_PROFILE_RELEASE_STRIP", "true");
    let built = Toolchain::find().ok_or(MISSING)?.set(&mut cargo)?;
    run(&mut cargo)?;
    let engine = built.join(TARGET).join("release/endless_gym_web.wasm");
    fs::read(&engine).map_err(describe(&engine))
}

/// The folder from which the program embeds the engines.
fn embedded() -> PathBuf {
    workspace().join("engine/page/built")
}

/// Builds the page and the program, and plays in a browser. Without a compiler for WebAssembly, the program embeds an engine that was
/// built earlier, or that of a release.
pub fn play(arguments: &[String]) -> Result<(), String> {
    if Toolchain::find().is_some() || !embedded().join(ENGINES[0]).exists() {
        build()?;
    }
    run(cargo(&["run", "--locked", "--release", "--bin", "endless", "--", "play", "--open"]).args(arguments))
}

/// Builds the page, and tests it, a page with environments of one's own, and the page of a running engine in a browser.
pub fn test() -> Result<(), String> {
    build()?;
    build_own()?;
    install()?;
    let tests = ["--ignored", "--test-threads", "1", "--skip", "measure"];
    // Of the whole workspace, since packages that are selected alone are compiled again with fewer features.
    run(cargo(&["test", "--workspace", "--locked", "--test", "browser", "--"]).args(tests))?;
    run(cargo(&["test", "--workspace", "--locked", "--test", "integration", "--"]).args(tests).arg("browser::"))
}

/// Installs in target/npm what the tests take from npm, in the versions of their lock file.
fn install() -> Result<(), String> {
    let folder = target()?.join("npm");
    recreate(&folder)?;
    for name in ["package.json", "package-lock.json"] {
        let from = workspace().join("bindings/web/tests").join(name);
        fs::copy(&from, folder.join(name)).map_err(describe(&from))?;
    }
    run(Command::new("npm").args(["ci", "--ignore-scripts", "--no-audit", "--no-fund"]).current_dir(&folder))
}

/// Writes a crate in target/own by `endless new`, and its page by `endless page`, with the environments of the tests.
fn build_own() -> Result<(), String> {
    run(&mut cargo(&["build", "--locked", "--bin", "endless"]))?;
    let (program, folder) = (target()?.join("debug/endless"), target()?.join("own"));
    recreate(&folder)?;
    run(Command::new(&program).args(["new", "own", "--path"]).arg(workspace()).current_dir(&folder))?;
    // With the versions of the dependencies that are tested.
    let own = workspace().join("bindings/web/tests/own/lib.rs");
    for (from, to) in [(own, "own/src/lib.rs"), (workspace().join("Cargo.lock"), "own/Cargo.lock")] {
        fs::copy(&from, folder.join(to)).map_err(describe(&from))?;
    }
    let mut page = Command::new(&program);
    page.args(["page", "--manifest-path", "own/Cargo.toml"]).current_dir(&folder);
    Toolchain::find().ok_or(MISSING)?.set(&mut page)?;
    // In a folder of its own, as for users.
    run(page.env("CARGO_TARGET_DIR", folder.join("target")))
}

fn write(folder: &Path, files: &[(&str, impl AsRef<[u8]>)]) -> Result<(), String> {
    recreate(folder)?;
    files.iter().try_for_each(|(name, bytes)| {
        let path = folder.join(name);
        fs::write(&path, bytes).map_err(describe(&path))
    })
}
