//! Virtual environments under the target directory.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::interpreters::Interpreter;

/// The root of the workspace.
pub fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."))
}

/// Cargo's target directory.
pub fn target() -> Result<PathBuf, String> {
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| workspace().join("target"), PathBuf::from);
    std::path::absolute(target).map_err(|error| error.to_string())
}

/// One call of `pip install`.
#[derive(Clone, Debug, Default)]
pub struct Install {
    /// Packages with their versions, and options of pip.
    pub arguments: Vec<String>,
    pub environment: Vec<(&'static str, String)>,
}

impl Install {
    pub fn of(packages: &[&str]) -> Self {
        Install { arguments: packages.iter().copied().map(str::to_owned).collect(), ..Install::default() }
    }

    /// The packages that a requirements file of the Python package lists.
    pub fn of_file(name: &str) -> Result<Self, String> {
        let file = workspace().join("bindings/python").join(name);
        let text = std::fs::read_to_string(&file).map_err(|error| format!("{}: {error}", file.display()))?;
        let packages: Vec<&str> = text.lines().filter(|line| !line.is_empty() && !line.starts_with('#')).collect();
        Ok(Install::of(&packages))
    }
}

/// The folder of the virtual environment `name`, whether or not it exists.
pub fn folder(name: &str) -> Result<PathBuf, String> {
    Ok(target()?.join("venvs").join(name))
}

/// The folder of the virtual environment `name`, created from the Python `base` with the packages of `installs`, in that order. An
/// existing one with the same packages is reused.
pub fn venv(name: &str, base: &Interpreter, installs: &[Install]) -> Result<PathBuf, String> {
    create(name, base, installs, None)
}

/// As [`venv`], with the packages of the environment `below`, made from the same Python, where it has none of its own. They take no
/// space a second time.
pub fn venv_above(below: &str, name: &str, base: &Interpreter, installs: &[Install]) -> Result<PathBuf, String> {
    create(name, base, installs, Some(below))
}

fn create(name: &str, base: &Interpreter, installs: &[Install], below: Option<&str>) -> Result<PathBuf, String> {
    let folder = folder(name)?;
    let stamp = folder.join("packages");
    // Without the place of the checkout, which may move.
    let mut wanted = format!("{installs:#?}").replace(&workspace().display().to_string(), ".");
    if let Some(below) = below {
        let path = self::folder(below)?.join("packages");
        wanted += &std::fs::read_to_string(&path).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    // Its Python is a link to one that may have been removed.
    if std::fs::read_to_string(&stamp).is_ok_and(|made| made == wanted) && folder.join("bin/python").exists() {
        return Ok(folder);
    }
    eprintln!("==> virtual environment {}", folder.display());
    execute(Command::new(&base.path).args(["-m", "venv", "--clear"]).arg(&folder))?;
    if let Some(below) = below {
        let packages = format!("lib/python3.{}/site-packages", base.minor);
        let path = folder.join(&packages).join("below.pth");
        std::fs::write(path, format!("../../../../{below}/{packages}\n")).map_err(|error| error.to_string())?;
    }
    for install in installs {
        let pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"];
        let mut command = Command::new(folder.join("bin/python"));
        command.args(pip).args(&install.arguments);
        execute(command.envs(install.environment.iter().map(|(name, value)| (name, value))))?;
    }
    std::fs::write(stamp, wanted).map_err(|error| error.to_string())?;
    Ok(folder)
}

/// Runs a command and waits for it.
pub fn execute(command: &mut Command) -> Result<(), String> {
    match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("{command:?} failed: {status}")),
        Err(error) => Err(format!("{command:?} cannot be run: {error}")),
    }
}
