//! The CPythons of this machine.

use std::path::PathBuf;
use std::process::{Command, Stdio};

/// The minor version of the original: pygame 2.4.0, which it requires, has wheels up to CPython 3.11.
pub const ORIGINAL: u32 = 11;

/// The versions of CPython 3 that the package supports and its tests know.
pub const SUPPORTED: std::ops::RangeInclusive<u32> = 10..=14;

/// A CPython that can make virtual environments.
#[derive(Clone, Debug)]
pub struct Interpreter {
    pub path: PathBuf,
    /// The y of version 3.y.
    pub minor: u32,
}

/// The CPython for the tests of the package: that of the original if there is one, otherwise the newest.
pub fn for_package() -> Option<Interpreter> {
    for_original().or_else(|| find().max_by_key(|python| python.minor))
}

/// One CPython of each minor version, in their order.
pub fn all() -> Vec<Interpreter> {
    let mut found: Vec<Interpreter> = find().collect();
    found.sort_by_key(|python| python.minor);
    found.dedup_by_key(|python| python.minor);
    found
}

/// The CPython for the original.
pub fn for_original() -> Option<Interpreter> {
    find().find(|python| python.minor == ORIGINAL)
}

/// All that can make virtual environments, on the path and of pyenv.
fn find() -> impl Iterator<Item = Interpreter> {
    // The original's first: where it is there, the others are not run.
    let minors = std::iter::once(ORIGINAL).chain(SUPPORTED.filter(|minor| *minor != ORIGINAL));
    let names = minors.map(|minor| format!("python3.{minor}")).chain(["python3".to_owned(), "python".to_owned()]);
    let on_path = names.map(PathBuf::from);
    let versions = std::env::var_os("PYENV_ROOT")
        .map(PathBuf::from)
        .or_else(|| std::env::home_dir().map(|home| home.join(".pyenv")))
        .and_then(|root| std::fs::read_dir(root.join("versions")).ok());
    let of_pyenv = versions.into_iter().flatten().flatten().map(|version| version.path().join("bin/python3"));
    on_path.chain(of_pyenv).filter_map(probe)
}

/// `None` for what cannot be run, is no supported CPython, or lacks `venv` or `ensurepip`, as Debian's does without python3-venv.
fn probe(python: PathBuf) -> Option<Interpreter> {
    const PROGRAM: &str = "import sys, venv, ensurepip\n\
        if sys.implementation.name == 'cpython' and sys.version_info[0] == 3: print(sys.version_info[1])\n\
        print(sys.executable)";
    let output = Command::new(python).args(["-I", "-c", PROGRAM]).stderr(Stdio::null()).output().ok()?;
    let printed = String::from_utf8(output.stdout).ok()?;
    let (minor, path) = printed.split_once('\n')?;
    let minor = minor.parse().ok().filter(|minor| SUPPORTED.contains(minor))?;
    output.status.success().then(|| Interpreter { path: path.trim_end().into(), minor })
}
