//! A Python with the original environments.

use std::path::PathBuf;

use crate::interpreters;
use crate::requirements::Requirement;
use crate::venv::{Install, folder, venv};

const NAME: &str = "original";

/// Pinned, so that every comparison is with the same original.
const PACKAGES: [&str; 2] = ["memory-gym==1.0.2", "numpy==1.26.4"];

/// The path of that Python; creates the virtual environment if it does not exist.
pub fn python() -> Result<PathBuf, String> {
    let base = interpreters::for_original().ok_or_else(|| Requirement::OriginalPython.missing())?;
    Ok(venv(NAME, &base, &[Install::of(&PACKAGES)])?.join("bin/python"))
}

/// The path that it has or will have.
pub fn path() -> Result<PathBuf, String> {
    Ok(folder(NAME)?.join("bin/python"))
}
