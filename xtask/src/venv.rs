//! Virtual environments under the target directory. uv installs their packages, from one cache by hard links: gigabytes of PyTorch
//! take their space once.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::interpreters::{self, Interpreter};
use crate::requirements::Requirement;

/// The root of the workspace.
pub fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."))
}

/// Cargo's target directory.
pub fn target() -> Result<PathBuf, String> {
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| workspace().join("target"), PathBuf::from);
    std::path::absolute(target).map_err(|error| error.to_string())
}

const UV: &str = "uv==0.13.9";

/// One call of `uv pip install`.
#[derive(Clone, Debug, Default)]
pub struct Install {
    /// Packages with their versions, and options of uv.
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

/// As [`venv`], with the packages of the environment `below`, made from the same Python, where it has none of its own.
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
    execute(Command::new(&base.path).args(["-m", "venv", "--without-pip", "--clear"]).arg(&folder))?;
    if let Some(below) = below {
        let packages = format!("lib/python3.{}/site-packages", base.minor);
        let path = folder.join(&packages).join("below.pth");
        std::fs::write(path, format!("../../../../{below}/{packages}\n")).map_err(|error| error.to_string())?;
    }
    for install in installs {
        let mut command = uv_pip_install(&folder)?;
        // As pip does: the first import of PyTorch takes long otherwise, and tests have time limits.
        command.arg("--compile-bytecode").args(&install.arguments);
        execute(command.envs(install.environment.iter().map(|(name, value)| (name, value))))?;
    }
    std::fs::write(stamp, wanted).map_err(|error| error.to_string())?;
    Ok(folder)
}

/// `uv pip install` into a virtual environment.
pub fn uv_pip_install(environment: &Path) -> Result<Command, String> {
    let mut command = uv()?;
    command.args(["pip", "install", "--quiet", "--python"]).arg(environment.join("bin/python"));
    Ok(command)
}

/// uv with its cache in the target directory, without the settings of the user. Installs it if necessary.
pub fn uv() -> Result<Command, String> {
    let folder = folder("uv")?;
    let program = folder.join("bin/uv");
    let stamp = folder.join("packages");
    let installed = || std::fs::read_to_string(&stamp).is_ok_and(|made| made == UV);
    // Stages that run side by side may need it at the same time.
    let lock = target()?.join("venvs/uv.lock");
    let describe = |error: std::io::Error| format!("{}: {error}", lock.display());
    std::fs::create_dir_all(target()?.join("venvs")).map_err(describe)?;
    let file = File::create(&lock).map_err(describe)?;
    file.lock().map_err(describe)?;
    if !installed() {
        let base = interpreters::for_package().ok_or_else(|| Requirement::Python.missing())?;
        execute(Command::new(&base.path).args(["-m", "venv", "--clear"]).arg(&folder))?;
        let pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", UV];
        execute(Command::new(folder.join("bin/python")).args(pip))?;
        std::fs::write(&stamp, UV).map_err(|error| error.to_string())?;
    }
    let mut command = Command::new(program);
    command.env("UV_CACHE_DIR", target()?.join("uv-cache")).env("UV_NO_CONFIG", "1");
    Ok(command)
}

/// Runs a command and waits for it.
pub fn execute(command: &mut Command) -> Result<(), String> {
    match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("{command:?} failed: {status}")),
        Err(error) => Err(format!("{command:?} cannot be run: {error}")),
    }
}
