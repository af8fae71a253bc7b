//! CPythons, virtual environments, and the tests of the Python packages.
//!
//! The environments are in `target/venvs`. uv installs the locked packages from one cache with hard links, so that a
//! package in several environments takes disk space only once.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use crate::shell::{describe, files_below, output, recreate, run, target, workspace};

const UV: &str = "uv==0.13.9";

/// The minor version of the original: pygame 2.4.0, which it requires, has wheels up to CPython 3.11.
pub const ORIGINAL: u32 = 11;

/// The minor versions of CPython 3 that the package supports.
pub const SUPPORTED: std::ops::RangeInclusive<u32> = 10..=14;

/// A CPython 3 of this minor version that can create virtual environments, from the path or pyenv.
pub fn interpreter(minor: u32) -> Option<PathBuf> {
    // Debian's lacks `ensurepip` without the package python3-venv.
    const PROGRAM: &str =
        "import sys, venv, ensurepip; print(sys.implementation.name, *sys.version_info[:2], sys.executable)";
    let pyenv = std::env::var_os("PYENV_ROOT").map(PathBuf::from);
    let pyenv = pyenv.or_else(|| Some(std::env::home_dir()?.join(".pyenv"))).unwrap_or_default().join("versions");
    let of_pyenv =
        std::fs::read_dir(pyenv).into_iter().flatten().flatten().map(|version| version.path().join("bin/python3"));
    let on_path = [format!("python3.{minor}"), "python3".to_owned(), "python".to_owned()].map(PathBuf::from);
    on_path.into_iter().chain(of_pyenv).find_map(|python| {
        let printed = output(Command::new(python).args(["-I", "-c", PROGRAM])).ok()?;
        printed.strip_prefix(&format!("cpython 3 {minor} ")).map(|path| PathBuf::from(path.trim_end()))
    })
}

/// The CPython of the tests: the original's if there is one, otherwise the newest.
pub fn base() -> Result<PathBuf, String> {
    let minors = std::iter::once(ORIGINAL).chain(SUPPORTED.rev());
    minors.into_iter().find_map(interpreter).ok_or_else(|| {
        "CPython 3.10 to 3.14 with venv is missing; apt-get install python3 python3-venv, or pyenv install 3.11"
            .to_owned()
    })
}

/// uv, installed from PyPI, with its cache in the target directory and without the user's settings.
pub fn uv(arguments: &[&str]) -> Result<Command, String> {
    let folder = venv_folder("uv")?;
    let stamp = folder.join("version");
    if !std::fs::read_to_string(&stamp).is_ok_and(|version| version == UV) {
        run(Command::new(base()?).args(["-m", "venv", "--clear"]).arg(&folder))?;
        let pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", UV];
        run(Command::new(folder.join("bin/python")).args(pip))?;
        std::fs::write(&stamp, UV).map_err(describe(&stamp))?;
    }
    let mut uv = Command::new(folder.join("bin/uv"));
    uv.args(arguments).env("UV_CACHE_DIR", target()?.join("uv-cache"));
    // Compile bytecode as pip does: otherwise the first import of PyTorch takes long, and tests have time limits.
    uv.env("UV_PYTHON_DOWNLOADS", "never").env("UV_COMPILE_BYTECODE", "1").env_remove("VIRTUAL_ENV");
    Ok(uv)
}

fn venv_folder(name: &str) -> Result<PathBuf, String> {
    Ok(target()?.join("venvs").join(name))
}

/// A virtual environment with these packages from PyPI.
pub fn tools(name: &str, python: &Path, packages: &[&str]) -> Result<PathBuf, String> {
    let folder = venv_folder(name)?;
    run(uv(&["venv", "--quiet", "--allow-existing", "--no-project", "--python"])?.arg(python).arg(&folder))?;
    run(pip_install(&folder)?.args(packages))?;
    Ok(folder)
}

/// `uv pip install` into a virtual environment.
pub fn pip_install(environment: &Path) -> Result<Command, String> {
    let mut command = uv(&["pip", "install", "--quiet", "--python"])?;
    command.arg(environment.join("bin/python"));
    Ok(command)
}

/// A virtual environment with the locked packages of a project's groups or extras, without the project itself.
pub fn sync(name: &str, project: &str, selection: &[&str]) -> Result<PathBuf, String> {
    let folder = venv_folder(name)?;
    // uv always considers the agents' lock file stale, since it contains a package from a folder.
    let lock = if project == "agents" { "--frozen" } else { "--locked" };
    let mut sync =
        uv(&["sync", "--quiet", lock, "--inexact", "--no-install-project", "--project", project, "--python"])?;
    run(sync.arg(base()?).args(selection).env("UV_PROJECT_ENVIRONMENT", &folder).current_dir(workspace()))?;
    Ok(folder)
}

/// The virtual environment of the tests that run everywhere.
pub fn environment() -> Result<PathBuf, String> {
    sync("python", "bindings/python", &["--group", "dev"])
}

/// The virtual environment with third-party libraries, including PufferLib without the games and the C trainer that it
/// would compile.
fn libraries() -> Result<PathBuf, String> {
    let folder = sync("libraries", "bindings/python", &["--group", "libraries"])?;
    let mut install = pip_install(&folder)?;
    install.args(["--no-deps", "--no-build-isolation", "pufferlib==3.0.0", "pettingzoo==1.26.1", "shimmy==2.0.1"]);
    install.env("NO_OCEAN", "1").env("NO_TRAIN", "1").env("PYTHONPATH", workspace().join("xtask/pufferlib"));
    run(&mut install)?;
    Ok(folder)
}

/// The agents' virtual environment, with the wheel and the agents.
fn agents() -> Result<PathBuf, String> {
    let folder = sync("agents", "agents", &["--all-extras", "--group", "dev", "--no-install-package", "endless-gym"])?;
    install_with_agents(&folder)?;
    Ok(folder)
}

/// Installs the wheel that [`wheel`] builds, and the agents without their dependencies.
fn install_with_agents(environment: &Path) -> Result<(), String> {
    install(environment)?;
    run(pip_install(environment)?.args(["--reinstall", "--no-deps"]).arg(workspace().join("agents")))
}

/// The path of the Python that has an original: Memory Gym, or POPGym.
pub fn original(popgym: bool) -> Result<PathBuf, String> {
    // Pinned, so that every comparison uses the same original.
    let (name, packages) = if popgym {
        ("popgym", &["popgym==1.0.7", "gymnasium==1.4.0", "mazelib==0.9.16", "cython==3.3.1", "numpy==2.4.6"][..])
    } else {
        ("original", &["memory-gym==1.0.2", "numpy==1.26.4"][..])
    };
    let base = interpreter(ORIGINAL).ok_or("CPython 3.11 is missing, which the originals require")?;
    Ok(tools(name, &base, packages)?.join("bin/python"))
}

/// Builds the wheel with a cargo profile, once in a run; the Rust tests use `dev`.
fn wheel(profile: &str) -> Result<(), String> {
    static BUILT: OnceLock<Result<(), String>> = OnceLock::new();
    let build = || {
        let bin = environment()?.join("bin");
        let wheels = target()?.join("wheels");
        recreate(&wheels)?;
        let mut maturin = Command::new(bin.join("maturin"));
        maturin.args(["build", "--locked", "--manifest-path", "bindings/python/Cargo.toml", "--profile", profile]);
        run(maturin.arg("--interpreter").arg(bin.join("python")).arg("--out").arg(&wheels).current_dir(workspace()))
    };
    BUILT.get_or_init(build).clone()
}

/// Installs the wheel.
fn install(environment: &Path) -> Result<(), String> {
    wheel("dev")?;
    let wheel = files_below(&target()?.join("wheels"))?.pop().ok_or("no wheel has been built")?;
    run(pip_install(environment)?.args(["--reinstall", "--no-deps"]).arg(wheel))
}

/// Lints all Python files and checks their format.
pub fn lint() -> Result<(), String> {
    let ruff = environment()?.join("bin/ruff");
    run(Command::new(&ruff).args(["format", "--check"]).current_dir(workspace()))?;
    run(Command::new(&ruff).arg("check").current_dir(workspace()))
}

/// Fails if files import each other in a cycle, or if a folder imports one above it.
pub fn cycles() -> Result<(), String> {
    run(Command::new(base()?).arg("xtask/cycles.py").current_dir(workspace()))
}

/// Checks types and runs the fast tests of the environments' package that need no third-party libraries.
pub fn test() -> Result<(), String> {
    let environment = environment()?;
    install(&environment)?;
    mypy(&environment, "bindings/python")?;
    pytest(&environment, "bindings/python", "not slow and not libraries and not original", &[])
}

/// Runs the tests of the environments' package that take long or need third-party libraries. Crates of users are built with
/// the packages in the folder `crates`.
pub fn test_libraries(crates: PathBuf) -> Result<(), String> {
    let environment = libraries()?;
    let rllib = sync("rllib", "bindings/python", &["--group", "rllib"])?;
    // Documentation snippets, an example and the notebook use the agents.
    [&environment, &rllib].into_iter().try_for_each(|environment| install_with_agents(environment))?;
    let gymnasiums = ["1.1.0", "1.2.3"].map(|version| {
        let packages = [&format!("gymnasium=={version}"), "numpy==2.4.6"];
        let folder = tools(&format!("gymnasium-{version}"), &base()?, &packages)?;
        Ok::<_, String>(format!("{version}={}", folder.join("bin/python").display()))
    });
    let gymnasiums = gymnasiums.into_iter().collect::<Result<Vec<_>, _>>()?.join(":");
    let paths = [
        ("ENDLESS_CRATES", crates),
        ("ENDLESS_LIBRARIES_PYTHON", rllib.join("bin/python")),
        ("ENDLESS_GYMNASIUM_PYTHONS", gymnasiums.into()),
    ];
    pytest(&environment, "bindings/python", "(slow or libraries) and not original", &paths)
}

/// Checks the types of the agents and runs all their tests.
pub fn test_agents() -> Result<(), String> {
    let environment = agents()?;
    mypy(&environment, "agents")?;
    pytest(&environment, "agents", "", &[])
}

/// Runs the tests of the environments' package that compare with the original.
pub fn test_original() -> Result<(), String> {
    let environment = libraries()?;
    install(&environment)?;
    let paths = [("ENDLESS_ORIGINAL_PYTHON", original(false)?), ("ENDLESS_POPGYM_PYTHON", original(true)?)];
    pytest(&environment, "bindings/python", "original", &paths)
}

fn mypy(environment: &Path, package: &str) -> Result<(), String> {
    let mut mypy = Command::new(environment.join("bin/python"));
    run(mypy.args(["-m", "mypy"]).current_dir(workspace().join(package)))
}

/// Runs tests, with variables that name the interpreters of other virtual environments.
fn pytest(environment: &Path, package: &str, markers: &str, paths: &[(&str, PathBuf)]) -> Result<(), String> {
    // Not `python -m pytest`, which would import the package's folder instead of the installed package.
    let mut pytest = Command::new(environment.join("bin/pytest"));
    pytest.args(["-q", "--timeout", "300", "--durations", "20", "-n", "logical", "--dist", "worksteal", "-m", markers]);
    // There is a worker for each core already.
    pytest.env("OMP_NUM_THREADS", "1");
    run(pytest.envs(paths.iter().cloned()).current_dir(workspace().join(package)))
}

/// Compares steps per second with the original.
pub fn bench(arguments: &[String]) -> Result<(), String> {
    wheel("release")?;
    let environment = libraries()?;
    install(&environment)?;
    let mut script = Command::new(environment.join("bin/python"));
    script.arg(workspace().join("benches/comparison.py")).arg("--original").arg(original(false)?);
    run(script.args(arguments))
}

/// Makes all pictures of the documentation.
pub fn pictures() -> Result<(), String> {
    let environment = libraries()?;
    install_with_agents(&environment)?;
    run(Command::new(environment.join("bin/python")).arg(workspace().join("xtask/pictures/make.py")))
}
