//! Folders of this machine, which no published file may name.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::venv::target;

/// Compiler flags that replace the folders of this machine in panic messages.
pub fn remap(source: &Path) -> Result<OsString, String> {
    let registry = cargo_home()?.join("registry/src");
    let (target, sysroot) = (target()?, sysroot()?);
    let mut flags = OsString::new();
    // Of several that match, the compiler applies the last.
    for (from, to) in [(&*target, "target"), (source, "endless-gym"), (&registry, "registry"), (&sysroot, "rust")] {
        if !flags.is_empty() {
            flags.push("\x1f");
        }
        flags.push("--remap-path-prefix=");
        flags.push(from);
        flags.push(format!("={to}"));
    }
    Ok(flags)
}

/// The folder of cargo's registry.
pub fn cargo_home() -> Result<PathBuf, String> {
    let home = std::env::var_os("CARGO_HOME").map(PathBuf::from);
    home.or_else(|| Some(std::env::home_dir()?.join(".cargo"))).ok_or_else(|| "CARGO_HOME must be set".to_owned())
}

/// The folder of the compiler.
pub fn sysroot() -> Result<PathBuf, String> {
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let output = Command::new(rustc).args(["--print", "sysroot"]).output();
    let output = output.map_err(|error| format!("rustc cannot be run: {error}"))?;
    Ok(PathBuf::from(String::from_utf8_lossy(&output.stdout).trim()))
}
