//! Installs what `cargo xtask dist` has built into clean environments, on each CPython of this machine, and uses it.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::dist;
use crate::python::run;
use crate::venv::{target, workspace};

/// Minor versions of the supported CPythons. The wheel is for all from 3.10 on, so newer ones are tried where they are installed.
const MINORS: std::ops::RangeInclusive<u32> = 10..=14;

/// The smallest agent, for ten updates.
const TRAIN: &[&str] = &[
    "--env MortarMayhem-Grid-v0 --agent none --preset quick --device cpu --environment.option command_count=[1]",
    "--environment.num-envs 8 --ppo.steps 16 --ppo.updates 10 --ppo.epochs 1 --threads 1 --run run",
];

/// A virtual environment of uv, which links files from one cache. Environments with PyTorch share its gigabytes.
struct Environment {
    uv: PathBuf,
    folder: PathBuf,
}

impl Environment {
    fn create(tools: &Path, python: &Path, name: &str) -> Result<Self, String> {
        let environment = Environment { uv: tools.join("bin/uv"), folder: target()?.join("packages").join(name) };
        let arguments = ["venv", "--quiet", "--clear", "--no-project", "--python"];
        run("uv venv", environment.uv(&arguments)?.arg(python).arg(&environment.folder))?;
        Ok(environment)
    }

    fn uv(&self, arguments: &[&str]) -> Result<Command, String> {
        let mut command = Command::new(&self.uv);
        command.args(arguments).env("UV_CACHE_DIR", target()?.join("uv-cache")).env("UV_NO_CONFIG", "1");
        Ok(command)
    }

    /// `uv pip install` into the environment, with the versions that this was tested with.
    fn install(&self, arguments: &[&str]) -> Result<Command, String> {
        let mut command = self.uv(&["pip", "install", "--quiet", "--python"])?;
        command.arg(self.folder.join("bin/python")).args(arguments);
        command.arg("--constraint").arg(workspace().join("xtask/packages/constraints.txt"));
        Ok(command)
    }

    /// A program of the environment, run in its folder, so that it imports the installed package.
    fn program(&self, name: &str) -> Command {
        let mut command = Command::new(self.folder.join("bin").join(name));
        command.current_dir(&self.folder).env_remove("PYTHONPATH");
        command
    }

    fn check(&self) -> Result<(), String> {
        let mut check = self.program("python");
        check.arg(workspace().join("xtask/packages/check.py")).arg(env!("CARGO_PKG_VERSION"));
        run("import, step and serve", &mut check)?;
        run("endless list", self.program("endless").arg("list").stdout(Stdio::null()))
    }
}

/// Tests the wheel on each CPython, and the source distribution on the oldest.
pub fn test() -> Result<(), String> {
    dist::build()?;
    let tools = dist::tools()?;
    let wheel = dist::only_file(&dist::folder()?, ".whl")?.display().to_string();
    let pythons = pythons();
    let Some((oldest, _)) = pythons.first() else {
        return Err("no CPython from 3.10 on is on the path or in pyenv's folder of versions".to_owned());
    };
    for (version, python) in &pythons {
        println!("==> CPython {version}, {}", python.display());
        let environment = Environment::create(&tools, python, version)?;
        run("install the wheel", &mut environment.install(&[&wheel])?)?;
        environment.check()?;
        train(&environment, &wheel)?;
    }
    println!("==> CPython {oldest}, from source");
    source(&tools, &pythons[0].1)
}

/// Trains the smallest agent where PyTorch has a wheel for this CPython, and otherwise says that it was not trained.
fn train(environment: &Environment, wheel: &str) -> Result<(), String> {
    // Only PyTorch's wheel is looked for: whatever else fails is an error.
    let mut probe = environment.install(&["--dry-run", "--no-deps", "--only-binary", "torch", "torch"])?;
    let probe = probe.output().map_err(|error| format!("uv cannot be run: {error}"))?;
    if !probe.status.success() {
        println!(
            "==> not run: training, since PyTorch cannot be installed\n{}",
            String::from_utf8_lossy(&probe.stderr)
        );
        return Ok(());
    }
    run("install the extra `agents`", &mut environment.install(&[&format!("{wheel}[agents]")])?)?;
    let arguments = TRAIN.iter().flat_map(|line| line.split(' '));
    run("endless-train, ten updates", environment.program("endless-train").args(arguments))?;
    let checkpoint = environment.folder.join("run/checkpoints/last.pt");
    if checkpoint.is_file() { Ok(()) } else { Err(format!("training must write {}", checkpoint.display())) }
}

/// Installs the source distribution. It is built with the profile of the tests, for which the dependencies have been compiled.
fn source(tools: &Path, python: &Path) -> Result<(), String> {
    let archive = dist::only_file(&dist::folder()?, ".tar.gz")?.display().to_string();
    let environment = Environment::create(tools, python, "source")?;
    let mut install = environment.install(&["--reinstall-package", "endless-gym", &archive])?;
    install.env("CARGO_TARGET_DIR", target()?).env("MATURIN_PEP517_ARGS", "--profile dev");
    run("install the source distribution", &mut install)?;
    environment.check()
}

/// The CPythons of this machine, one of each minor version, in order: on the path, or of pyenv, whose shims run only some of them.
fn pythons() -> Vec<(String, PathBuf)> {
    let pyenv = Command::new("pyenv").arg("root").output().ok().filter(|output| output.status.success());
    let versions = pyenv.map(|output| Path::new(String::from_utf8_lossy(&output.stdout).trim()).join("versions"));
    let mut folders: Vec<PathBuf> = std::env::var_os("PATH").iter().flat_map(std::env::split_paths).collect();
    for entry in versions.and_then(|versions| std::fs::read_dir(versions).ok()).into_iter().flatten().flatten() {
        folders.push(entry.path().join("bin"));
    }
    let found = MINORS.filter_map(|minor| {
        let candidates = folders.iter().map(|folder| folder.join(format!("python3.{minor}")));
        let python = candidates.into_iter().find(|python| is_cpython(python, minor));
        if python.is_none() {
            println!("==> not run: CPython 3.{minor}, which is not installed");
        }
        Some((format!("3.{minor}"), python?))
    });
    found.collect()
}

fn is_cpython(python: &Path, minor: u32) -> bool {
    const SCRIPT: &str = "import sys; print(sys.implementation.name, sys.version_info.minor)";
    let output = Command::new(python).args(["-c", SCRIPT]).stderr(Stdio::null()).output();
    output.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).trim() == format!("cpython {minor}"))
}
