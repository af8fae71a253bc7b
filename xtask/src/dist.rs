//! What a release consists of, made into `target/dist`: the source distribution and the wheel of the Python package, and the crates.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::python::run;
use crate::requirements::Requirement;
use crate::venv::{Install, target, venv, workspace};
use crate::wasm::Toolchain;
use crate::{interpreters, paths, web};

const TOOLS: [&str; 4] = ["auditwheel==6.8.2", "maturin==1.16.0", "wheel==0.48.0", "ziglang==0.17.1"];

/// The oldest C library that the wheel supports. Zig links against any version of it, whatever the machine has.
const PLATFORM: &str = "manylinux_2_17";

/// The published crates, in the order in which they depend on each other.
const CRATES: [&str; 6] = [
    "endless-gym-core",
    "endless-gym-service",
    "endless-gym-page",
    "endless-gym-view",
    "endless-gym-cli",
    "endless-gym",
];

const LICENCES: [&str; 2] = ["LICENSE-APACHE", "LICENSE-MIT"];

/// Builds and checks all of them.
pub fn build() -> Result<(), String> {
    let folder = folder()?;
    let tools = tools()?;
    match Toolchain::find() {
        Some(_) => web::build()?,
        None => println!("The program will not contain the page, since there is no compiler for WebAssembly."),
    }
    recreate(&folder)?;
    let source = source_distribution(&tools, &folder)?;
    wheel(&tools, &source, &folder)?;
    crates(&folder)?;
    for file in files_below(&folder)? {
        let bytes = fs::metadata(&file).map_err(|error| describe(&file, &error))?.len();
        println!("{:>12} bytes  {}", bytes, file.display());
    }
    Ok(())
}

/// Where the release's files are.
pub fn folder() -> Result<PathBuf, String> {
    Ok(target()?.join("dist"))
}

/// The virtual environment with maturin, zig and the tools that inspect wheels.
pub fn tools() -> Result<PathBuf, String> {
    let base = interpreters::for_package().ok_or_else(|| Requirement::Python.missing())?;
    venv("packaging", &base, &[Install::of(&TOOLS)])
}

/// The only file of a folder with this suffix.
pub fn only_file(folder: &Path, suffix: &str) -> Result<PathBuf, String> {
    let mut found = files_below(folder)?;
    found.retain(|path| path.to_string_lossy().ends_with(suffix));
    match &found[..] {
        [file] => Ok(file.clone()),
        _ => Err(format!("{} must hold one file *{suffix}, found {found:?}", folder.display())),
    }
}

/// Makes the source distribution and unpacks it. Returns the folder of its `pyproject.toml`.
fn source_distribution(tools: &Path, folder: &Path) -> Result<PathBuf, String> {
    let mut maturin = maturin(tools, "sdist")?;
    maturin.arg("--manifest-path").arg(workspace().join("bindings/python/Cargo.toml")).arg("--out").arg(folder);
    run("maturin sdist", &mut maturin)?;
    let unpacked = target()?.join("dist-source");
    recreate(&unpacked)?;
    // The files of the archive have a fixed time. With the present time instead, cargo sees that they changed.
    let mut tar = Command::new("tar");
    tar.args(["--extract", "--touch", "--strip-components=1", "--file"]).arg(only_file(folder, ".tar.gz")?);
    run("unpack the source distribution", tar.arg("--directory").arg(&unpacked))?;
    // The archive lacks members of the workspace, which the lock file still lists. All other versions stay.
    run("cargo update --workspace", cargo().args(["update", "--quiet", "--workspace"]).current_dir(&unpacked))?;
    Ok(unpacked)
}

/// Builds the wheel from the unpacked source distribution, which is thereby complete, and checks it.
fn wheel(tools: &Path, source: &Path, folder: &Path) -> Result<(), String> {
    let built = target()?.join("dist-wheel");
    recreate(&built)?;
    let mut maturin = maturin(tools, "build")?;
    maturin.current_dir(source).args(["--locked", "--zig", "--compatibility", PLATFORM]);
    maturin.arg("--target-dir").arg(target()?).arg("--out").arg(&built);
    maturin.env("CARGO_ENCODED_RUSTFLAGS", paths::remap(source)?);
    run(&format!("maturin build, {PLATFORM}"), &mut maturin)?;

    // The bill of materials names the folders of the local crates. `wheel pack` writes the new checksums.
    let python = tools.join("bin/python");
    let built_wheel = only_file(&built, ".whl")?;
    let unpack = ["-m", "wheel", "unpack", "--dest"];
    run("wheel unpack", Command::new(&python).args(unpack).arg(&built).arg(&built_wheel))?;
    let name = built_wheel.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let unpacked = built.join(name.splitn(3, '-').take(2).collect::<Vec<_>>().join("-"));
    for file in files_below(&unpacked)?.iter().filter(|file| file.to_string_lossy().ends_with(".cyclonedx.json")) {
        let text = fs::read_to_string(file).map_err(|error| describe(file, &error))?;
        let text = text.replace(&source.display().to_string(), "/endless-gym");
        fs::write(file, text).map_err(|error| describe(file, &error))?;
    }
    check_contents(&unpacked)?;
    let pack = ["-m", "wheel", "pack", "--dest-dir"];
    run("wheel pack", Command::new(&python).args(pack).arg(folder).arg(&unpacked))?;
    check_tag(tools, &only_file(folder, ".whl")?)
}

/// Fails if a licence is missing, or if a file names a folder of this machine.
fn check_contents(wheel: &Path) -> Result<(), String> {
    let files = files_below(wheel)?;
    for licence in LICENCES {
        if !files.iter().any(|file| file.file_name().is_some_and(|name| name == licence)) {
            return Err(format!("the wheel must contain {licence}"));
        }
    }
    let local: Vec<String> = [workspace().to_path_buf(), target()?, paths::cargo_home()?, paths::sysroot()?]
        .iter()
        .map(|path| path.display().to_string())
        .collect();
    for file in files {
        let bytes = fs::read(&file).map_err(|error| describe(&file, &error))?;
        for path in &local {
            if bytes.windows(path.len()).any(|window| window == path.as_bytes()) {
                return Err(format!("{} must not name folders of this machine, found {path}", file.display()));
            }
        }
    }
    Ok(())
}

/// Fails if auditwheel finds symbols that are newer than the wheel's tag permits, or if the tag is not for all CPythons from 3.10.
fn check_tag(tools: &Path, wheel: &Path) -> Result<(), String> {
    let name = wheel.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let expected = format!("{PLATFORM}_{}", std::env::consts::ARCH);
    if !name.contains("-cp310-abi3-") || !name.contains(&expected) {
        return Err(format!("the wheel's name must contain cp310-abi3 and {expected}, got {name}"));
    }
    let output = Command::new(tools.join("bin/auditwheel")).args(["show", "--json"]).arg(wheel).output();
    let output = output.map_err(|error| format!("auditwheel cannot be run: {error}"))?;
    let text = String::from_utf8_lossy(&output.stdout);
    println!("==> auditwheel show");
    let overall = text.lines().find(|line| line.contains("\"overall_tag\"")).unwrap_or_default();
    if !output.status.success() || !overall.contains(&expected) {
        let errors = String::from_utf8_lossy(&output.stderr);
        return Err(format!("auditwheel must find {expected}, as in {name}, got\n{text}{errors}"));
    }
    println!("    {}", overall.trim());
    Ok(())
}

/// Packages the crates and builds each from its package, against the packages of the others.
fn crates(folder: &Path) -> Result<(), String> {
    let build = target()?.join("packaged");
    remove_earlier(&build)?;
    let mut cargo = cargo();
    cargo.args(["package", "--locked", "--allow-dirty", "--target-dir"]).arg(&build);
    // The profiles of the workspace do not apply.
    cargo.env("CARGO_PROFILE_DEV_DEBUG", "false");
    for name in CRATES {
        cargo.args(["--package", name]);
    }
    run("cargo package", &mut cargo)?;
    for name in CRATES {
        let version = env!("CARGO_PKG_VERSION");
        let package = build.join("package").join(format!("{name}-{version}.crate"));
        check_files(name, &package)?;
        fs::copy(&package, folder.join(format!("{name}-{version}.crate")))
            .map_err(|error| describe(&package, &error))?;
    }
    // The tests of the core read recorded cases, which its package must contain.
    let manifest = build.join(format!("package/endless-gym-core-{}/Cargo.toml", env!("CARGO_PKG_VERSION")));
    let mut check = self::cargo();
    check.env("CARGO_PROFILE_DEV_DEBUG", "false");
    check.args(["check", "--quiet", "--tests", "--manifest-path"]).arg(manifest);
    run("cargo check --tests, packaged core", check.arg("--target-dir").arg(&build))
}

/// Removes what earlier runs unpacked and built of these crates. Cargo packages a workspace by way of a temporary registry in the
/// target directory, and what comes from a registry never changes for it as long as the version is the same.
fn remove_earlier(build: &Path) -> Result<(), String> {
    let sources = paths::cargo_home()?.join("registry/src");
    // The folders of other registries begin with their host.
    let registries = entries(&sources)?.into_iter().filter(|(name, _)| name.starts_with('-'));
    let mut parents: Vec<PathBuf> = registries.map(|(_, path)| path).collect();
    parents.push(build.join("debug/.fingerprint"));
    for parent in parents {
        for (name, path) in entries(&parent)? {
            if name.starts_with("endless-gym") {
                fs::remove_dir_all(&path).map_err(|error| describe(&path, &error))?;
            }
        }
    }
    Ok(())
}

/// Names and paths of what is in a folder; none if there is no such folder.
fn entries(folder: &Path) -> Result<Vec<(String, PathBuf)>, String> {
    if !folder.exists() {
        return Ok(Vec::new());
    }
    let named = |entry: fs::DirEntry| (entry.file_name().to_string_lossy().into_owned(), entry.path());
    let entries = fs::read_dir(folder).and_then(|entries| entries.map(|entry| entry.map(named)).collect());
    entries.map_err(|error| describe(folder, &error))
}

/// Fails if a crate's package lacks a licence, or holds a file that no build, test or reader of it needs.
fn check_files(name: &str, package: &Path) -> Result<(), String> {
    const TOP: [&str; 9] = [
        ".cargo_vcs_info.json",
        "ARCHITECTURE.md",
        "CHANGELOG.md",
        "Cargo.lock",
        "Cargo.toml",
        "Cargo.toml.orig",
        "LICENSE-APACHE",
        "LICENSE-MIT",
        "README.md",
    ];
    let output = Command::new("tar").args(["--list", "--file"]).arg(package).output();
    let output = output.map_err(|error| format!("tar cannot be run: {error}"))?;
    let list = String::from_utf8_lossy(&output.stdout);
    let files: Vec<&str> = list.lines().filter_map(|line| Some(line.split_once('/')?.1)).collect();
    if let Some(missing) = LICENCES.iter().find(|licence| !files.contains(licence)) {
        return Err(format!("the package of {name} must contain {missing}, got {files:?}"));
    }
    let is_source = |file: &str| {
        let folders = ["src/", "tests/", "benches/", "engine/examples/"];
        let kinds = [".rs", ".py", ".json", ".txt"];
        let is_code =
            folders.iter().any(|folder| file.starts_with(folder)) && kinds.iter().any(|kind| file.ends_with(kind));
        let is_page = name == "endless-gym-page" && (file.starts_with("files/") || file.starts_with("built/"));
        let is_view = name == "endless-gym-view" && file.starts_with("files/");
        is_code || is_page || is_view || file == "build.rs" || file.starts_with("tests/reference/")
    };
    match files.iter().find(|file| !TOP.contains(file) && !is_source(file)) {
        Some(stray) => Err(format!("the package of {name} contains {stray}; list what it needs in `include`")),
        None => Ok(()),
    }
}

fn cargo() -> Command {
    Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
}

/// Maturin, which looks for zig in the Python that is first on the path.
fn maturin(tools: &Path, task: &str) -> Result<Command, String> {
    let mut path = tools.join("bin").into_os_string();
    path.push(":");
    path.push(std::env::var_os("PATH").unwrap_or_default());
    let mut command = Command::new(tools.join("bin/maturin"));
    command.arg(task).env("PATH", path);
    Ok(command)
}

fn recreate(folder: &Path) -> Result<(), String> {
    if folder.exists() {
        fs::remove_dir_all(folder).map_err(|error| describe(folder, &error))?;
    }
    fs::create_dir_all(folder).map_err(|error| describe(folder, &error))
}

fn files_below(folder: &Path) -> Result<Vec<PathBuf>, String> {
    let mut files = Vec::new();
    let mut open = vec![folder.to_path_buf()];
    while let Some(folder) = open.pop() {
        for entry in fs::read_dir(&folder).map_err(|error| describe(&folder, &error))? {
            let path = entry.map_err(|error| describe(&folder, &error))?.path();
            if path.is_dir() { open.push(path) } else { files.push(path) }
        }
    }
    files.sort();
    Ok(files)
}

fn describe(path: &Path, error: &std::io::Error) -> String {
    format!("{}: {error}", path.display())
}
