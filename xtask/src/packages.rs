//! Installs what `cargo xtask dist` has built into clean environments, on each CPython of this machine, and uses it.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::python::run;
use crate::requirements::Requirement;
use crate::venv::{target, uv, uv_pip_install, workspace};
use crate::wasm::Toolchain;
use crate::{dist, interpreters};

/// The smallest agent, for ten updates.
const TRAIN: &[&str] = &[
    "--env MortarMayhem-Grid-v0 --agent none --preset quick --device cpu --environment.option command_count=[1]",
    "--environment.num-envs 8 --ppo.steps 16 --ppo.updates 10 --ppo.epochs 1 --threads 1 --run run",
];

/// A virtual environment without anything that the package does not ask for.
struct Environment {
    folder: PathBuf,
}

impl Environment {
    fn create(python: &Path, name: &str) -> Result<Self, String> {
        let environment = Environment { folder: target()?.join("packages").join(name) };
        let arguments = ["venv", "--quiet", "--clear", "--no-project", "--python"];
        run("uv venv", uv()?.args(arguments).arg(python).arg(&environment.folder))?;
        Ok(environment)
    }

    /// `uv pip install` into the environment, with the versions that this was tested with.
    fn install(&self, arguments: &[&str]) -> Result<Command, String> {
        let mut command = uv_pip_install(&self.folder)?;
        command.args(arguments);
        command.arg("--constraint").arg(workspace().join("xtask/packages/constraints.txt"));
        Ok(command)
    }

    /// A program of the environment, run in its folder, so that it imports the installed package.
    fn program(&self, name: &str) -> Command {
        let mut command = Command::new(self.folder.join("bin").join(name));
        command.current_dir(&self.folder).env_remove("PYTHONPATH");
        command
    }

    /// Uses the installed package, whose program may have to contain the page.
    fn check(&self, has_page: bool) -> Result<(), String> {
        let mut check = self.program("python");
        check.arg(workspace().join("xtask/packages/check.py")).arg(env!("CARGO_PKG_VERSION"));
        check.arg(if has_page { "page" } else { "no page" });
        run("import, step and serve", &mut check)?;
        run("endless list", self.program("endless").arg("list").stdout(Stdio::null()))
    }
}

/// Tests the wheel on each CPython, and the source distribution on the oldest.
pub fn test() -> Result<(), String> {
    dist::build()?;
    let wheel = dist::only_file(&dist::folder()?, ".whl")?.display().to_string();
    let pythons = interpreters::all();
    let oldest = pythons.first().ok_or_else(|| Requirement::Python.missing())?;
    for minor in interpreters::SUPPORTED {
        let Some(python) = pythons.iter().find(|python| python.minor == minor) else {
            println!("==> not run: CPython 3.{minor}, which is not installed");
            continue;
        };
        println!("==> CPython 3.{minor}, {}", python.path.display());
        let environment = Environment::create(&python.path, &format!("3.{minor}"))?;
        run("install the wheel", &mut environment.install(&[&wheel])?)?;
        environment.check(Toolchain::find().is_some())?;
        train(&environment, &wheel)?;
    }
    println!("==> CPython 3.{}, from source", oldest.minor);
    source(&oldest.path)
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
    let agents = workspace().join("agents").display().to_string();
    run("install the agents", &mut environment.install(&[wheel, &agents])?)?;
    let arguments = TRAIN.iter().flat_map(|line| line.split(' '));
    run("endless-train, ten updates", environment.program("endless-train").args(arguments))?;
    let checkpoint = environment.folder.join("run/checkpoints/last.pt");
    if checkpoint.is_file() { Ok(()) } else { Err(format!("training must write {}", checkpoint.display())) }
}

/// Installs the source distribution. It is built with the profile of the tests, for which the dependencies have been compiled.
fn source(python: &Path) -> Result<(), String> {
    let archive = dist::only_file(&dist::folder()?, ".tar.gz")?.display().to_string();
    let environment = Environment::create(python, "source")?;
    let mut install = environment.install(&["--reinstall-package", "endless-gym", &archive])?;
    install.env("CARGO_TARGET_DIR", target()?).env("MATURIN_PEP517_ARGS", "--profile dev");
    run("install the source distribution", &mut install)?;
    environment.check(false)
}
