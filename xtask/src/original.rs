//! A Python with the original environments, in a virtual environment under the target directory.

use std::path::{Path, PathBuf};
use std::process::Command;

/// Pinned, so that every comparison is with the same original. pygame 2.4.0, which it asks for, ends at Python 3.11.
const PACKAGES: [&str; 2] = ["memory-gym==1.0.2", "numpy==1.26.4"];
const PYTHONS: [&str; 2] = ["python3.11", "python3"];

/// The path of that Python, which is made if it is not there yet.
pub fn python() -> Result<PathBuf, String> {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."));
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| workspace.join("target"), PathBuf::from);
    let folder = std::path::absolute(target.join("venvs/original")).map_err(|error| error.to_string())?;
    let python = folder.join("bin/python");
    let complete = folder.join("complete");
    if complete.exists() {
        return Ok(python);
    }
    eprintln!("==> {} in {}", PACKAGES.join(" and "), folder.display());
    let base = PYTHONS.into_iter().find(|python| version(python).is_some_and(|text| text.starts_with("Python 3.11."))).ok_or(
        "the original needs Python 3.11, and neither `python3.11` nor `python3` is one; install it, for example with pyenv",
    )?;
    execute(Command::new(base).args(["-m", "venv", "--clear"]).arg(&folder))?;
    execute(
        Command::new(&python).args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check"]).args(PACKAGES),
    )?;
    std::fs::write(complete, "").map_err(|error| error.to_string())?;
    Ok(python)
}

fn version(python: &str) -> Option<String> {
    let output = Command::new(python).arg("--version").output().ok()?;
    Some(String::from_utf8_lossy(&output.stdout).into_owned())
}

fn execute(command: &mut Command) -> Result<(), String> {
    match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("{command:?} failed: {status}")),
        Err(error) => Err(format!("{command:?} cannot be run: {error}")),
    }
}
