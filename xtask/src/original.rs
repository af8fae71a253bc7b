//! A Python with the original environments.

use std::path::PathBuf;
use std::process::Command;

use crate::venv::{Install, venv};

/// Pinned, so that every comparison is with the same original. It requires pygame 2.4.0, which supports Python up to 3.11.
const PACKAGES: [&str; 2] = ["memory-gym==1.0.2", "numpy==1.26.4"];
const PYTHONS: [&str; 2] = ["python3.11", "python3"];

/// The path of that Python; creates the virtual environment if it does not exist.
pub fn python() -> Result<PathBuf, String> {
    Ok(venv("original", base()?, &[Install::of(&PACKAGES)])?.join("bin/python"))
}

/// The name of a Python 3.11.
pub fn base() -> Result<&'static str, String> {
    let is_it = |python: &&str| version(python).is_some_and(|text| text.starts_with("Python 3.11."));
    PYTHONS.into_iter().find(is_it).ok_or_else(|| {
        "the original needs Python 3.11; neither `python3.11` nor `python3` is one. Install it, for example with pyenv"
            .to_owned()
    })
}

fn version(python: &str) -> Option<String> {
    let output = Command::new(python).arg("--version").output().ok()?;
    Some(String::from_utf8_lossy(&output.stdout).into_owned())
}
