//! Paths of the project and this machine, and commands.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// The root of the workspace.
pub fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."))
}

/// Cargo's target directory.
pub fn target() -> Result<PathBuf, String> {
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| workspace().join("target"), PathBuf::from);
    std::path::absolute(target).map_err(|error| error.to_string())
}

/// The folders of this machine that no release may name, with what they are: the target directory, a source, cargo's registry and
/// the compiler.
pub fn folders(source: &Path) -> Result<[(PathBuf, &'static str); 4], String> {
    let home = std::env::var_os("CARGO_HOME").map(PathBuf::from);
    let home = home.or_else(|| Some(std::env::home_dir()?.join(".cargo"))).ok_or("CARGO_HOME must be set")?;
    let compiler = PathBuf::from(output(Command::new("rustc").args(["--print", "sysroot"]))?.trim());
    let registry = home.join("registry/src");
    Ok([(target()?, "target"), (source.into(), "endless-gym"), (registry, "registry"), (compiler, "rust")])
}

/// Compiler flags that replace paths of this machine in panic messages.
pub fn remap(source: &Path) -> Result<String, String> {
    // If several match, the compiler applies the last.
    let flags = folders(source)?.map(|(from, to)| format!("--remap-path-prefix={}={to}", from.display()));
    Ok(flags.join("\x1f"))
}

/// The cargo that runs this program, for the same toolchain and settings, in the root of the workspace.
pub fn cargo(arguments: &[&str]) -> Command {
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.args(arguments).current_dir(workspace());
    cargo
}

/// Prints and runs a command, and fails if the command fails.
pub fn run(command: &mut Command) -> Result<(), String> {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    let words: Vec<String> = words.map(|word| word.to_string_lossy().into_owned()).collect();
    println!("==> {}", words.join(" "));
    match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("{} failed: {status}", words.join(" "))),
        Err(error) => Err(format!("{} cannot be run: {error}", words[0])),
    }
}

/// What a command prints.
pub fn output(command: &mut Command) -> Result<String, String> {
    let output = command.output().map_err(|error| format!("{command:?} cannot be run: {error}"))?;
    if !output.status.success() {
        return Err(format!("{command:?} failed: {}", String::from_utf8_lossy(&output.stderr)));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Whether a command can be run and succeeds.
pub fn succeeds(command: &mut Command) -> bool {
    command.stdin(Stdio::null()).output().is_ok_and(|output| output.status.success())
}

/// Whether there is a program of that name.
pub fn has(program: &str) -> bool {
    succeeds(Command::new(program).arg("--version"))
}

/// Empties a folder, or creates it.
pub fn recreate(folder: &Path) -> Result<(), String> {
    if folder.exists() {
        std::fs::remove_dir_all(folder).map_err(describe(folder))?;
    }
    std::fs::create_dir_all(folder).map_err(describe(folder))
}

/// All files below a folder, sorted.
pub fn files_below(folder: &Path) -> Result<Vec<PathBuf>, String> {
    let (mut files, mut open) = (Vec::new(), vec![folder.to_path_buf()]);
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(&folder).map_err(describe(&folder))? {
            let path = entry.map_err(describe(&folder))?.path();
            if path.is_dir() { open.push(path) } else { files.push(path) }
        }
    }
    files.sort();
    Ok(files)
}

/// The message of an error with a file.
pub fn describe<E: Display>(path: &Path) -> impl Fn(E) -> String {
    move |error| format!("{}: {error}", path.display())
}
