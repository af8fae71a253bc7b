//! `endless page`.

use std::env::var_os;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use endless_gym_core::files;
use endless_gym_core::pool::Registry;
use serde_json::Value as Json;

use crate::failure::Failure;
use crate::output::print;

const TARGET: &str = "wasm32-unknown-unknown";

/// An exported function in WebAssembly: the length of its name, the name, and the kind 0. `endless_gym_web::module!` defines it.
const EXPORT: &[u8] = b"\x0cenvironments\0";

/// Arguments of `endless page`.
///
/// Builds the library of the crate with cargo for WebAssembly. In the program of a crate that `endless new` wrote, run
/// `cargo run -- page --out site`, and open the page with a web server, such as `python -m http.server --directory site`.
#[derive(clap::Args)]
pub struct Args {
    /// Folder for the files of the page. Other files there are kept.
    #[arg(long, value_name = "FOLDER", default_value = "site")]
    out: PathBuf,
    /// The crate's manifest [default: that of `cargo run`, or as cargo finds it from the current folder].
    #[arg(long, value_name = "FILE")]
    manifest_path: Option<PathBuf>,
}

/// Runs `endless page`.
pub fn run(registry: &Registry, args: &Args) -> Result<(), Failure> {
    let of_run = || var_os("CARGO_MANIFEST_DIR").map(|folder| Path::new(&folder).join("Cargo.toml"));
    let engine = build(args.manifest_path.clone().or_else(of_run))?;
    let bytes = fs::read(&engine).map_err(|error| format!("cannot read {}: {error}", engine.display()))?;
    if !bytes.windows(EXPORT.len()).any(|part| part == EXPORT) {
        return Err("the library of the crate must call `endless_gym_web::module!(registry())` on the target \
            architecture wasm32; a crate that `endless new` writes shows how"
            .into());
    }
    let page = endless_gym_page::files(&[("engine.wasm", &bytes)], |id| registry.spec(id).is_ok());
    for (name, bytes) in &page {
        let to = args.out.join(name);
        let written = fs::create_dir_all(&args.out).and_then(|()| files::replace(&to, bytes));
        written.map_err(|error| format!("cannot write {}: {error}", to.display()))?;
    }
    print(format_args!(
        "wrote the page, {} files, to {}; a web server shows it:\n\n  python -m http.server --directory {}",
        page.len(),
        args.out.display(),
        args.out.display()
    ))
}

/// Builds the library of the crate for WebAssembly, and returns its path.
fn build(manifest: Option<PathBuf>) -> Result<PathBuf, Failure> {
    let here = std::env::current_dir().unwrap_or_default();
    if manifest.is_none() && !here.ancestors().any(|folder| folder.join("Cargo.toml").exists()) {
        let advice = "run it in the folder of one, or with --manifest-path FILE; `endless new NAME` makes one";
        return Err(format!(
            "the page shows the environments of a crate, and there is none in {}: {advice}",
            here.display()
        )
        .into());
    }
    let mut cargo = Command::new(var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.args(["build", "--release", "--lib", "--target", TARGET, "--message-format=json-render-diagnostics"]);
    cargo.args(manifest.iter().flat_map(|path| ["--manifest-path".as_ref(), path.as_os_str()]));
    // Browsers download the result.
    cargo.env("CARGO_PROFILE_RELEASE_DEBUG", "false").env("CARGO_PROFILE_RELEASE_STRIP", "true");
    let output = cargo.stderr(Stdio::inherit()).output().map_err(|error| format!("cargo cannot be run: {error}"))?;
    if !output.status.success() {
        return Err(format!(
            "cargo could not build the crate for WebAssembly; if it cannot find the crate `core` or `std`, \
             run `rustup target add {TARGET}`"
        )
        .into());
    }
    let messages = serde_json::Deserializer::from_slice(&output.stdout).into_iter::<Json>().filter_map(Result::ok);
    let files = messages.flat_map(|message| message["filenames"].as_array().cloned().unwrap_or_default());
    let files = files.filter_map(|file| Some(PathBuf::from(file.as_str()?)));
    // The last one is the library of the crate itself.
    let engine = files.filter(|file| file.extension().is_some_and(|end| end == "wasm")).last();
    engine.ok_or_else(|| {
        "the library of the crate must have the type `cdylib`: `crate-type = [\"cdylib\", \"rlib\"]`".into()
    })
}
