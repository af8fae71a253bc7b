//! The core for WebAssembly: without threads and without a system's entropy.

use std::path::Path;
use std::process::Command;
use std::time::Instant;

use crate::cargo;
use crate::venv::execute;

const TARGET: &str = "wasm32-unknown-unknown";

/// Builds the core where the target's standard library is installed, and otherwise says that it was not built.
pub fn check() -> Result<(), String> {
    if installed()? {
        return build();
    }
    println!("==> not run: the core for {TARGET}, whose standard library is missing; `rustup target add {TARGET}`");
    Ok(())
}

/// Builds the core.
pub fn build() -> Result<(), String> {
    println!("==> cargo build --target {TARGET}");
    let start = Instant::now();
    let arguments = ["build", "--release", "--locked", "--package", "endless-gym-core", "--no-default-features"];
    execute(cargo::command().args(arguments).args(["--target", TARGET]))?;
    println!("    {:.1} s", start.elapsed().as_secs_f64());
    Ok(())
}

/// Whether the toolchain has the target's standard library.
fn installed() -> Result<bool, String> {
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let output = Command::new(rustc).args(["--print", "target-libdir", "--target", TARGET]).output();
    let output = output.map_err(|error| format!("rustc cannot be run: {error}"))?;
    let folder = String::from_utf8_lossy(&output.stdout);
    Ok(output.status.success() && Path::new(folder.trim()).is_dir())
}
