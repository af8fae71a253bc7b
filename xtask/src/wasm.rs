//! The core for WebAssembly: without threads and without a system's entropy.

use std::ffi::OsString;
use std::fmt;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::venv::{execute, target, workspace};
use crate::{cargo, paths};

const TARGET: &str = "wasm32-unknown-unknown";

/// A compiler with the target's standard library, or with the sources to build it from.
pub enum Toolchain {
    /// The one that runs this.
    Own,
    /// Debian's compiler in the folder where `.ci/wasm-toolchain` unpacks it; Debian has no compiled standard library of that version.
    Debian(PathBuf),
}

impl Toolchain {
    pub fn find() -> Option<Self> {
        let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
        let output = Command::new(rustc).args(["--print", "target-libdir", "--target", TARGET]).output().ok()?;
        if output.status.success() && Path::new(String::from_utf8_lossy(&output.stdout).trim()).is_dir() {
            return Some(Toolchain::Own);
        }
        let folder = target().ok()?.join("wasm-toolchain/usr");
        folder.join("bin/rustc").exists().then_some(Toolchain::Debian(folder))
    }

    /// `cargo build` for the target.
    ///
    /// # Errors
    ///
    /// If the target directory or the search path is no usable path.
    pub fn build(&self) -> Result<Command, String> {
        let mut command = cargo::command();
        command.args(["build", "--locked", "--target", TARGET]);
        // A browser downloads the result, and programs contain it: without names, lines and folders of this machine.
        command.env("CARGO_ENCODED_RUSTFLAGS", paths::remap(workspace())?);
        command.env("CARGO_PROFILE_RELEASE_DEBUG", "false").env("CARGO_PROFILE_RELEASE_STRIP", "true");
        let Toolchain::Debian(folder) = self else { return Ok(command) };
        let joined = |variable: &str, first: &[&str]| -> Result<OsString, String> {
            let before = std::env::var_os(variable).unwrap_or_default();
            let first = first.iter().map(|path| folder.join(path));
            let all = first.chain(std::env::split_paths(&before).filter(|path| !path.as_os_str().is_empty()));
            std::env::join_paths(all).map_err(|error| format!("{variable}: {error}"))
        };
        let libraries = format!("lib/{}-linux-gnu", std::env::consts::ARCH);
        // A folder of its own, so that the two compilers do not invalidate each other's builds.
        command.args(["-Zbuild-std=std,panic_abort", "--target-dir"]).arg(target()?.join("wasm"));
        command.env("RUSTC", folder.join("bin/rustc")).env("RUSTC_BOOTSTRAP", "1");
        command.env("PATH", joined("PATH", &["bin", "lib/llvm/bin"])?);
        command.env("LD_LIBRARY_PATH", joined("LD_LIBRARY_PATH", &[&libraries, "lib/llvm/lib"])?);
        Ok(command)
    }

    /// The folder of the built files, with one folder for each profile.
    ///
    /// # Errors
    ///
    /// If the target directory is no usable path.
    pub fn output(&self) -> Result<PathBuf, String> {
        let target = target()?;
        Ok(match self {
            Toolchain::Own => target,
            Toolchain::Debian(_) => target.join("wasm"),
        }
        .join(TARGET))
    }

    /// The error where there is none.
    pub fn missing() -> String {
        format!("no compiler for {TARGET}; rustup target add {TARGET}, or on Debian .ci/wasm-toolchain")
    }
}

impl fmt::Display for Toolchain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Toolchain::Own => f.write_str("of this toolchain"),
            Toolchain::Debian(folder) => write!(f, "built from source by the compiler in {}", folder.display()),
        }
    }
}

/// Builds the core.
pub fn build() -> Result<(), String> {
    let toolchain = Toolchain::find().ok_or_else(Toolchain::missing)?;
    execute(toolchain.build()?.args(["--release", "--package", "endless-gym-core", "--no-default-features"]))
}
