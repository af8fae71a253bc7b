//! The Python package: wheel, lints, tests and benchmarks.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use crate::original;
use crate::venv::{Install, execute, target, venv, workspace};

/// Lints, checks types, and runs the tests.
pub fn test() -> Result<(), String> {
    let package = package();
    // The profile of the tests, whose dependencies have been built.
    let folder = install("dev")?;
    let ruff = |what: &str, arguments: &[&str]| {
        let program = folder.join("bin/ruff");
        run(what, Command::new(&program).current_dir(&package).args(arguments))?;
        let mut benches = Command::new(&program);
        benches.current_dir(workspace()).args(arguments).args([
            "--config",
            "bindings/python/pyproject.toml",
            "benches",
            "xtask/pictures",
        ]);
        run(&format!("{what}, benches and pictures"), &mut benches)
    };
    ruff("ruff format", &["format", "--check"])?;
    ruff("ruff check", &["check"])?;
    run("mypy", Command::new(folder.join("bin/mypy")).current_dir(&package))?;
    let mut pytest = Command::new(folder.join("bin/pytest"));
    pytest.args(["-q", "--timeout", "300"]).current_dir(&package);
    run("pytest", pytest.env("ENDLESS_ORIGINAL_PYTHON", original::python()?))
}

/// Compares steps per second with the original's and, for scale, with EnvPool's own environments where it can be installed.
pub fn bench(arguments: &[&str]) -> Result<(), String> {
    let folder = install("release")?;
    let envpool = venv("envpool", original::base()?, &[Install::of(&["envpool==1.2.5"])]);
    let mut script = Command::new(folder.join("bin/python"));
    script.arg(workspace().join("benches/comparison.py"));
    script.arg("--original").arg(original::python()?).args(arguments);
    match envpool {
        Ok(folder) => drop(script.arg("--envpool").arg(folder.join("bin/python"))),
        Err(message) => eprintln!("without EnvPool: {message}"),
    }
    run("benches/comparison.py", &mut script)
}

fn package() -> PathBuf {
    workspace().join("bindings/python")
}

/// Builds the wheel and installs it into a virtual environment with the test tools. Returns the environment's folder.
pub fn install(profile: &str) -> Result<PathBuf, String> {
    let folder = venv("python", original::base()?, &[Install::of_file("requirements-test.txt")?, pufferlib()?])?;
    let wheels = target()?.join("wheels");
    let _ = std::fs::remove_dir_all(&wheels);
    let mut maturin = Command::new(folder.join("bin/maturin"));
    maturin.args(["build", "--locked", "--profile", profile, "--interpreter"]).arg(folder.join("bin/python"));
    maturin.arg("--manifest-path").arg(package().join("Cargo.toml")).arg("--out").arg(&wheels);
    run("maturin build", &mut maturin)?;
    let wheel = only_file(&wheels)?;
    let install = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--force-reinstall", "--no-deps"];
    run("pip install", Command::new(folder.join("bin/python")).args(install).arg(wheel))?;
    Ok(folder)
}

fn only_file(folder: &Path) -> Result<PathBuf, String> {
    let file = std::fs::read_dir(folder).ok().and_then(|mut files| files.next()).and_then(Result::ok);
    Ok(file.ok_or("maturin built no wheel")?.path())
}

/// PufferLib, which PyPI has only as a source archive, without the games and the trainer in C that it would compile.
fn pufferlib() -> Result<Install, String> {
    let mut install = Install::of_file("requirements-pufferlib.txt")?;
    install.arguments.extend(["--no-deps", "--no-build-isolation"].map(str::to_owned));
    let path = workspace().join("xtask/pufferlib").display().to_string();
    install.environment = vec![("NO_OCEAN", "1".to_owned()), ("NO_TRAIN", "1".to_owned()), ("PYTHONPATH", path)];
    Ok(install)
}

/// Runs a command, with its name and duration.
pub fn run(what: &str, command: &mut Command) -> Result<(), String> {
    println!("==> {what}");
    let start = Instant::now();
    execute(command)?;
    println!("    {:.1} s", start.elapsed().as_secs_f64());
    Ok(())
}
