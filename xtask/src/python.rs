//! The Python package: its wheel, and the checks and tests of it.

use std::process::Command;
use std::time::Instant;

use crate::original;
use crate::venv::{Install, execute, target, venv, workspace};

/// Builds the wheel, installs it into a virtual environment beside the tools that it is tested with, lints, checks the types, and
/// runs the tests.
pub fn test() -> Result<(), String> {
    let package = workspace().join("bindings/python");
    let folder = venv("python", original::base()?, &[Install::of_file("requirements-test.txt")?, pufferlib()?])?;
    let wheels = target()?.join("wheels");
    let _ = std::fs::remove_dir_all(&wheels);

    // The profile of the tests, whose dependencies are built already.
    let mut maturin = Command::new(folder.join("bin/maturin"));
    maturin.args(["build", "--locked", "--profile", "dev", "--interpreter"]).arg(folder.join("bin/python"));
    maturin.arg("--manifest-path").arg(package.join("Cargo.toml")).arg("--out").arg(&wheels);
    run("maturin build", &mut maturin)?;
    let wheel = std::fs::read_dir(&wheels).ok().and_then(|mut files| files.next()).and_then(Result::ok);
    let wheel = wheel.ok_or("maturin built no wheel")?.path();
    let install = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--force-reinstall", "--no-deps"];
    run("pip install", Command::new(folder.join("bin/python")).args(install).arg(wheel))?;

    run("ruff format", Command::new(folder.join("bin/ruff")).args(["format", "--check"]).arg(&package))?;
    run("ruff check", Command::new(folder.join("bin/ruff")).arg("check").arg(&package))?;
    run("mypy", Command::new(folder.join("bin/mypy")).current_dir(&package))?;
    let mut pytest = Command::new(folder.join("bin/pytest"));
    pytest.args(["-q", "--timeout", "300"]).current_dir(&package);
    run("pytest", pytest.env("ENDLESS_ORIGINAL_PYTHON", original::python()?))
}

/// PufferLib, of which PyPI has a source archive alone, without the games and the trainer in C that it would compile.
fn pufferlib() -> Result<Install, String> {
    let mut install = Install::of_file("requirements-pufferlib.txt")?;
    install.arguments.extend(["--no-deps", "--no-build-isolation"].map(str::to_owned));
    let path = workspace().join("xtask/pufferlib").display().to_string();
    install.environment = vec![("NO_OCEAN", "1".to_owned()), ("NO_TRAIN", "1".to_owned()), ("PYTHONPATH", path)];
    Ok(install)
}

fn run(what: &str, command: &mut Command) -> Result<(), String> {
    println!("==> {what}");
    let start = Instant::now();
    execute(command)?;
    println!("    {:.1} s", start.elapsed().as_secs_f64());
    Ok(())
}
