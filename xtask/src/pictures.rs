//! The pictures of the documentation.

use std::process::Command;

use crate::python;
use crate::venv::workspace;

/// Makes all pictures in `docs/images`.
pub fn make() -> Result<(), String> {
    // Which frames there are does not depend on the profile.
    python::install("dev")?;
    let folder = python::environment()?;
    let script = workspace().join("xtask/pictures/make.py");
    python::run("xtask/pictures/make.py", Command::new(folder.join("bin/python")).arg(script))
}
