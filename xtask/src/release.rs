//! Builds the files of a release in `target/dist`: the source distribution and the wheel of the Python package, the crates, and the
//! page that plays.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::shell::{cargo, describe, files_below, folders, recreate, remap, run, target, workspace};
use crate::{python, web};

/// Maturin as in the tests. Zig links against any version of the C library.
pub const TOOLS: [&str; 2] = ["maturin==1.16.0", "ziglang==0.17.1"];

/// The oldest C library that the wheel supports; maturin fails if a symbol is newer.
const PLATFORM: &str = "manylinux_2_17";

/// The published crates, dependencies first.
const CRATES: [&str; 12] = [
    "endless-gym-core",
    "endless-gym-memory-gym",
    "endless-gym-popgym",
    "endless-gym-service",
    "endless-gym-page",
    "endless-gym-view",
    "endless-gym-kernels",
    "endless-gym-trainer",
    "endless-gym-cli",
    "endless-gym",
    "endless-gym-python",
    "endless-gym-web",
];

const LICENCES: [&str; 3] = ["LICENSE-APACHE", "LICENSE-MIT", "NOTICE"];

/// Builds and checks all files.
pub fn build() -> Result<(), String> {
    let folder = folder()?;
    let tools = python::tools("packaging", &python::base()?, &TOOLS)?;
    recreate(&folder)?;
    match web::Toolchain::find() {
        Some(_) => {
            web::build()?;
            page(&folder)?;
        }
        None => println!("Without the page, in the program and as an archive; missing: {}", web::MISSING),
    }
    let source = source_distribution(&tools, &folder)?;
    wheel(&tools, &source, &folder)?;
    crates()?;
    for name in CRATES.map(|name| format!("{}.crate", versioned(name))) {
        let package = target()?.join("package").join(&name);
        fs::copy(&package, folder.join(name)).map_err(describe(&package))?;
    }
    for file in files_below(&folder)? {
        println!("{:>12} bytes  {}", fs::metadata(&file).map_err(describe(&file))?.len(), file.display());
    }
    Ok(())
}

fn folder() -> Result<PathBuf, String> {
    Ok(target()?.join("dist"))
}

/// The only file of a folder with this suffix.
fn only_file(folder: &Path, suffix: &str) -> Result<PathBuf, String> {
    let mut found = files_below(folder)?;
    found.retain(|path| path.to_string_lossy().ends_with(suffix));
    match &found[..] {
        [file] => Ok(file.clone()),
        _ => Err(format!("{} must hold one file *{suffix}, found {found:?}", folder.display())),
    }
}

/// Packs the page, for any web server and for `cargo xtask play` without a compiler for WebAssembly. The same page gives the same
/// archive.
fn page(folder: &Path) -> Result<(), String> {
    let name = versioned("endless-gym-web");
    let options = "--create --gzip --sort=name --mtime=@0 --owner=0 --group=0 --numeric-owner --mode=u=rwX,go=rX";
    let mut tar = Command::new("tar");
    tar.args(options.split(' ')).arg(format!("--transform=s,^\\.,{name},"));
    tar.arg("--file").arg(folder.join(format!("{name}.tar.gz")));
    run(tar.arg("--directory").arg(web::folder()?).arg("."))
}

/// The end of the name of the source distribution, which is not that of the page.
fn source_archive() -> String {
    format!("endless_gym-{}.tar.gz", env!("CARGO_PKG_VERSION"))
}

/// Makes the source distribution and unpacks it. Returns the folder of its `pyproject.toml`.
fn source_distribution(tools: &Path, folder: &Path) -> Result<PathBuf, String> {
    let manifest = workspace().join("bindings/python/Cargo.toml");
    run(maturin(tools, "sdist").arg("--manifest-path").arg(manifest).arg("--out").arg(folder))?;
    let unpacked = target()?.join("dist-source");
    recreate(&unpacked)?;
    // The files in the archive have a fixed time. `--touch` sets the current time, so that cargo sees that they changed.
    let mut tar = Command::new("tar");
    tar.args(["--extract", "--touch", "--strip-components=1", "--file"]).arg(only_file(folder, &source_archive())?);
    run(tar.arg("--directory").arg(&unpacked))?;
    // The lock file lists members of the workspace that the archive lacks. All other versions stay.
    run(cargo(&["update", "--quiet", "--workspace"]).current_dir(&unpacked))?;
    Ok(unpacked)
}

/// Builds the wheel from the unpacked source distribution, which shows that it is complete, and checks the wheel.
fn wheel(tools: &Path, source: &Path, folder: &Path) -> Result<(), String> {
    let built = target()?.join("dist-wheel");
    recreate(&built)?;
    let mut maturin = maturin(tools, "build");
    maturin.current_dir(source).args(["--locked", "--zig", "--compatibility", PLATFORM]);
    maturin.arg("--target-dir").arg(target()?).arg("--out").arg(&built);
    run(maturin.env("CARGO_ENCODED_RUSTFLAGS", remap(source)?))?;

    let unpacked = built.join("unpacked");
    let wheel = only_file(&built, ".whl")?;
    run(Command::new(tools.join("bin/python")).args(["-m", "zipfile", "-e"]).arg(&wheel).arg(&unpacked))?;
    check_contents(&unpacked)?;
    let name = wheel.file_name().unwrap_or_default();
    fs::copy(&wheel, folder.join(name)).map(drop).map_err(describe(&wheel))
}

/// Fails if a licence is missing, or if a file contains a path of this machine.
fn check_contents(wheel: &Path) -> Result<(), String> {
    let files = files_below(wheel)?;
    let has = |licence: &&str| files.iter().any(|file| file.file_name().is_some_and(|name| name == *licence));
    if let Some(missing) = LICENCES.iter().find(|licence| !has(licence)) {
        return Err(format!("the wheel must contain {missing}"));
    }
    let local = folders(workspace())?.map(|(path, _)| path.display().to_string());
    for file in files {
        let bytes = fs::read(&file).map_err(describe(&file))?;
        if let Some(path) = local.iter().find(|path| bytes.windows(path.len()).any(|part| part == path.as_bytes())) {
            return Err(format!("{} must not name folders of this machine, found {path}", file.display()));
        }
    }
    Ok(())
}

/// Packages the crates, and unpacks them into a folder, which it returns. A test builds a crate that depends on all of them
/// from there, which shows that they are complete.
pub fn crates() -> Result<PathBuf, String> {
    let (packages, unpacked) = (target()?.join("package"), target()?.join("packaged"));
    let selected = CRATES.map(|name| format!("--package={name}"));
    run(cargo(&["package", "--locked", "--allow-dirty", "--no-verify", "--quiet"]).args(selected))?;
    recreate(&unpacked)?;
    for name in CRATES.map(versioned) {
        // As of the source distribution, the times in the archive are fixed.
        let mut tar = Command::new("tar");
        tar.args(["--extract", "--touch", "--file"]).arg(packages.join(format!("{name}.crate")));
        run(tar.arg("--directory").arg(&unpacked))?;
        if let Some(missing) = LICENCES.iter().find(|licence| !unpacked.join(&name).join(licence).exists()) {
            return Err(format!("the package of {name} must contain {missing}"));
        }
    }
    Ok(unpacked)
}

fn versioned(name: &str) -> String {
    format!("{name}-{}", env!("CARGO_PKG_VERSION"))
}

/// Maturin with a path on which it finds zig's Python first.
fn maturin(tools: &Path, task: &str) -> Command {
    let mut path = tools.join("bin").into_os_string();
    path.push(":");
    path.push(std::env::var_os("PATH").unwrap_or_default());
    let mut command = Command::new(tools.join("bin/maturin"));
    command.arg(task).env("PATH", path);
    command
}

/// Builds all files, installs the wheel for each CPython on this machine and the source distribution for the oldest,
/// and tests them.
pub fn test() -> Result<(), String> {
    build()?;
    let wheel = only_file(&folder()?, ".whl")?;
    let page = if web::Toolchain::find().is_some() { "page" } else { "no page" };
    let mut oldest = None;
    for minor in python::SUPPORTED {
        let Some(python) = python::interpreter(minor) else {
            println!("not run: CPython 3.{minor}, which is not installed");
            continue;
        };
        install_and_use(&python, &format!("3.{minor}"), &wheel, page)?;
        oldest.get_or_insert(python);
    }
    let oldest = oldest.ok_or("no CPython has been found")?;
    install_and_use(&oldest, "source", &only_file(&folder()?, &source_archive())?, "no page")
}

/// Installs a package with the locked versions of its dependencies, and nothing else, into a virtual environment, and tests it.
fn install_and_use(python: &Path, name: &str, package: &Path, page: &str) -> Result<(), String> {
    let folder = target()?.join("packages").join(name);
    recreate(&folder)?;
    let constraints = folder.join("constraints.txt");
    let export = ["export", "--quiet", "--locked", "--no-emit-project", "--no-hashes", "--project", "bindings/python"];
    run(python::uv(&export)?.arg("--output-file").arg(&constraints).current_dir(workspace()))?;
    let environment = folder.join("venv");
    run(python::uv(&["venv", "--quiet", "--no-project", "--python"])?.arg(python).arg(&environment))?;
    let mut install = python::pip_install(&environment)?;
    install.args(["--reinstall-package", "endless-gym", "--constraint"]).arg(&constraints).arg(package);
    // Builds a source distribution with the tests' profile, for which the dependencies are already compiled. Without lines,
    // so that cargo does not take these crates for those of the workspace.
    install.env("CARGO_TARGET_DIR", target()?).env("CARGO_PROFILE_DEV_DEBUG", "false");
    run(install.env("MATURIN_PEP517_ARGS", "--profile dev"))?;
    // Not in the workspace, so that it imports the installed package.
    let mut check = Command::new(environment.join("bin/python"));
    check.arg(workspace().join("xtask/packages/check.py")).args([env!("CARGO_PKG_VERSION"), page]);
    run(check.current_dir(&folder).env_remove("PYTHONPATH"))?;
    run(Command::new(environment.join("bin/endless")).arg("list").current_dir(&folder))
}
