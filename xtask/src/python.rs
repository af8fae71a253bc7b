//! The Python package: wheel, lints, tests and benchmarks.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use crate::requirements::Requirement;
use crate::venv::{Install, execute, folder, target, uv_pip_install, venv, venv_above, workspace};
use crate::{interpreters, original};

const NAME: &str = "python";
const LIBRARIES: &str = "libraries";

/// The folder of the virtual environment with what the tests need; creates it if it does not exist.
pub fn environment() -> Result<PathBuf, String> {
    let base = interpreters::for_package().ok_or_else(|| Requirement::Python.missing())?;
    venv(NAME, &base, &[Install::of_file("requirements-test.txt")?, pufferlib()?])
}

/// The folder of the virtual environment for the examples of libraries that do not fit in [`environment`], whose packages it has
/// too; creates it if it does not exist.
pub fn libraries() -> Result<PathBuf, String> {
    environment()?;
    let base = interpreters::for_package().ok_or_else(|| Requirement::Python.missing())?;
    venv_above(NAME, LIBRARIES, &base, &[Install::of_file("requirements-libraries.txt")?])
}

/// Checks the format of the Python files and lints them.
pub fn ruff() -> Result<(), String> {
    let program = environment()?.join("bin/ruff");
    for arguments in [["format", "--check"].as_slice(), &["check"]] {
        for package in packages() {
            execute(Command::new(&program).current_dir(package).args(arguments))?;
        }
        let others = [
            "--config",
            "bindings/python/pyproject.toml",
            "benches",
            "docs",
            "tests/reference",
            "xtask/packages",
            "xtask/pictures",
        ];
        execute(Command::new(&program).current_dir(workspace()).args(arguments).args(others))?;
    }
    Ok(())
}

/// Checks the types of the packages.
pub fn mypy() -> Result<(), String> {
    let python = environment()?.join("bin/python");
    packages().iter().try_for_each(|package| {
        // The agents' imports of the other package are found by the path, since the two may be checked before they are installed.
        let mut mypy = Command::new(&python);
        execute(mypy.args(["-m", "mypy"]).env("MYPYPATH", self::package()).current_dir(package))
    })
}

/// Runs the tests of both packages that a marker expression selects, as [`install`] installed them.
pub fn pytest(markers: &str) -> Result<(), String> {
    packages().iter().try_for_each(|package| pytest_of(package, markers))
}

/// Runs the tests of the environments' package that need the original.
pub fn pytest_original() -> Result<(), String> {
    pytest_of(&package(), "original")
}

fn pytest_of(package: &Path, markers: &str) -> Result<(), String> {
    let mut pytest = Command::new(environment()?.join("bin/pytest"));
    pytest.args(["-q", "--timeout", "300", "--durations", "30", "-m", markers]).current_dir(package);
    pytest.env("ENDLESS_ORIGINAL_PYTHON", original::path()?);
    execute(pytest.env("ENDLESS_LIBRARIES_PYTHON", folder(LIBRARIES)?.join("bin/python")))
}

/// Compares steps per second with the original's and, for scale, with EnvPool's own environments where it can be installed.
pub fn bench(arguments: &[String]) -> Result<(), String> {
    install("release")?;
    let folder = environment()?;
    let base = interpreters::for_package().ok_or_else(|| Requirement::Python.missing())?;
    let envpool = venv("envpool", &base, &[Install::of(&["envpool==1.2.5"])]);
    let mut script = Command::new(folder.join("bin/python"));
    script.arg(workspace().join("benches/comparison.py"));
    script.arg("--original").arg(original::python()?).args(arguments);
    match envpool {
        Ok(folder) => drop(script.arg("--envpool").arg(folder.join("bin/python"))),
        Err(message) => eprintln!("without EnvPool: {message}"),
    }
    execute(&mut script)
}

fn package() -> PathBuf {
    workspace().join("bindings/python")
}

/// The folders of the environments' package and of the agents'.
fn packages() -> [PathBuf; 2] {
    [package(), workspace().join("agents")]
}

/// Builds the wheel in a profile of cargo and installs it and the agents into the virtual environment.
pub fn install(profile: &str) -> Result<(), String> {
    let folder = environment()?;
    let wheels = target()?.join("wheels");
    let _ = std::fs::remove_dir_all(&wheels);
    let mut maturin = Command::new(folder.join("bin/maturin"));
    maturin.args(["build", "--locked", "--profile", profile, "--interpreter"]).arg(folder.join("bin/python"));
    maturin.arg("--manifest-path").arg(package().join("Cargo.toml")).arg("--out").arg(&wheels);
    execute(&mut maturin)?;
    let wheel = only_file(&wheels)?;
    execute(uv_pip_install(&folder)?.args(["--reinstall", "--no-deps"]).arg(wheel).arg(workspace().join("agents")))
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

/// Runs a command, and prints what it is and how long it took.
pub fn run(what: &str, command: &mut Command) -> Result<(), String> {
    println!("==> {what}");
    let start = Instant::now();
    execute(command)?;
    println!("    {:.1} s", start.elapsed().as_secs_f64());
    Ok(())
}
