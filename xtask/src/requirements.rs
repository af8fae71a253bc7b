//! What the stages of the tests require of the machine.

use std::path::Path;
use std::process::{Command, Stdio};

use crate::{interpreters, venv, wasm};

/// Bytes that the target directory takes in a full run. 25 GB were measured with CPython 3.10 to 3.13, most of them PyTorch, which
/// each CPython has a build of.
const DISK: u64 = 27_000_000_000;

/// Bytes free in /dev/shm for the tests: several engines at a time, each below 100 MB.
const SHARED_MEMORY: u64 = 1 << 30;

/// One thing that a stage requires.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub enum Requirement {
    Linker,
    Python,
    OriginalPython,
    Valgrind,
    Wasm,
    Browser,
    MountNamespaces,
    Root,
    SharedMemory,
    Disk,
}

impl Requirement {
    pub fn name(self) -> &'static str {
        match self {
            Requirement::Linker => "C compiler and linker",
            Requirement::Python => "CPython 3.10 to 3.14",
            Requirement::OriginalPython => "CPython 3.11",
            Requirement::Valgrind => "valgrind",
            Requirement::Wasm => "Rust's standard library for wasm32-unknown-unknown",
            Requirement::Browser => "Chromium",
            Requirement::MountNamespaces => "mount namespaces",
            Requirement::Root => "the rights of root",
            Requirement::SharedMemory => "shared memory",
            Requirement::Disk => "disk space",
        }
    }

    /// How to get it.
    pub fn remedy(self) -> &'static str {
        match self {
            Requirement::Linker => "apt-get install gcc libc6-dev",
            Requirement::Python => "apt-get install python3 python3-venv, or pyenv install 3.11",
            Requirement::OriginalPython => {
                "pyenv install 3.11, or apt-get install python3.11 python3.11-venv; pygame 2.4.0, which the original requires, \
                 has no wheels for later versions"
            }
            Requirement::Valgrind => "apt-get install valgrind",
            Requirement::Wasm => {
                "rustup target add wasm32-unknown-unknown, or on Debian .ci/wasm-toolchain, which unpacks Debian's compiler under \
                 target/"
            }
            Requirement::Browser => "apt-get install chromium, or set CHROMIUM to the program's path",
            Requirement::MountNamespaces => {
                "permit `unshare --mount --map-root-user` (util-linux): sysctl kernel.unprivileged_userns_clone=1, or in a container \
                 --cap-add SYS_ADMIN"
            }
            Requirement::Root => "run it as root: sudo --preserve-env env \"PATH=$PATH\" cargo xtask test",
            Requirement::SharedMemory => "mount -o remount,size=2G /dev/shm, or in a container --shm-size=2g",
            Requirement::Disk => "free the space, or set CARGO_TARGET_DIR to a larger file system",
        }
    }

    /// The message where it is missing.
    pub fn missing(self) -> String {
        format!("{} is missing; {}", self.name(), self.remedy())
    }

    /// What was found.
    ///
    /// # Errors
    ///
    /// What is missing.
    pub fn probe(self) -> Result<String, String> {
        match self {
            Requirement::Linker => first_line("cc", &["--version"]),
            Requirement::Python => interpreter(interpreters::for_package()),
            Requirement::OriginalPython => interpreter(interpreters::for_original()),
            Requirement::Valgrind => first_line("valgrind", &["--version"]),
            Requirement::Wasm => wasm::Toolchain::find().map(|found| found.to_string()).ok_or("not found".to_owned()),
            Requirement::Browser => browser(),
            Requirement::MountNamespaces => mount_namespaces(),
            Requirement::Root if rustix::process::geteuid().is_root() => Ok("user root".to_owned()),
            Requirement::Root => Err(format!("user {}", rustix::process::geteuid().as_raw())),
            Requirement::SharedMemory => free(Path::new("/dev/shm"), SHARED_MEMORY),
            Requirement::Disk => {
                let target = venv::target()?;
                std::fs::create_dir_all(&target).map_err(|error| format!("{}: {error}", target.display()))?;
                let taken = taken(&target);
                free(&target, DISK.saturating_sub(taken))
            }
        }
    }
}

fn interpreter(found: Option<interpreters::Interpreter>) -> Result<String, String> {
    found
        .map(|python| python.path.display().to_string())
        .ok_or_else(|| "not found with the modules venv and ensurepip, on the path or of pyenv".to_owned())
}

fn first_line(program: &str, arguments: &[&str]) -> Result<String, String> {
    match Command::new(program).args(arguments).stderr(Stdio::null()).output() {
        Ok(output) if output.status.success() => {
            Ok(String::from_utf8_lossy(&output.stdout).lines().next().unwrap_or_default().to_owned())
        }
        Ok(output) => Err(format!("`{program}` failed: {}", output.status)),
        Err(error) => Err(format!("`{program}`: {error}")),
    }
}

/// The tests look for the same.
fn browser() -> Result<String, String> {
    if let Ok(path) = std::env::var("CHROMIUM") {
        return first_line(&path, &["--version"]);
    }
    let programs = ["chromium", "chromium-browser", "google-chrome"].map(|name| first_line(name, &["--version"]));
    let found = programs.into_iter().find_map(Result::ok);
    found.ok_or_else(|| "none of `chromium`, `chromium-browser` and `google-chrome` is on the path".to_owned())
}

/// Whether a process may mount in a namespace of its own.
fn mount_namespaces() -> Result<String, String> {
    let mut unshare = Command::new("unshare");
    unshare.args(["--mount", "--map-root-user", "mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]);
    let output = unshare.output().map_err(|error| format!("`unshare`: {error}"))?;
    let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    if output.status.success() { Ok("permitted".to_owned()) } else { Err(said) }
}

/// Whether a file system has `needed` bytes free.
fn free(folder: &Path, needed: u64) -> Result<String, String> {
    let found = rustix::fs::statvfs(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let free = found.f_bavail * found.f_frsize;
    let said = format!("{:.1} GB free in {}, {:.1} GB needed", giga(free), folder.display(), giga(needed));
    if free >= needed { Ok(said) } else { Err(said) }
}

fn giga(bytes: u64) -> f64 {
    bytes as f64 / 1e9
}

/// The bytes that a folder takes; what cannot be read counts nothing.
fn taken(folder: &Path) -> u64 {
    let Ok(output) = Command::new("du").args(["-s", "-B1"]).arg(folder).stderr(Stdio::null()).output() else {
        return 0;
    };
    String::from_utf8_lossy(&output.stdout).split_whitespace().next().and_then(|bytes| bytes.parse().ok()).unwrap_or(0)
}
