//! `endless new`.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use endless_gym_core::pool::Registry;

use crate::failure::Failure;
use crate::output::print;

/// Arguments of `endless new`.
#[derive(clap::Args)]
pub struct Args {
    /// Name of the folder, the crate and the Python package: words of lower-case letters and digits, joined by `_`.
    name: String,
    /// Build with this checkout of Endless Gym instead of the published crates.
    #[arg(long, value_name = "CHECKOUT")]
    path: Option<PathBuf>,
}

const TASK: &str = include_str!("../../template/src/task.rs");

/// The files of a crate named `t_maze`, with the id `TMaze-v0`. The manifest has another name in the template, since cargo leaves
/// folders with a `Cargo.toml` out of a package.
const TEMPLATE: [(&str, &str); 9] = [
    ("Cargo.toml", include_str!("../../template/manifest.toml")),
    ("README.md", include_str!("../../template/README.md")),
    ("example.py", include_str!("../../template/example.py")),
    ("pyproject.toml", include_str!("../../template/pyproject.toml")),
    ("python/t_maze/__init__.py", include_str!("../../template/python/t_maze/__init__.py")),
    ("src/lib.rs", include_str!("../../template/src/lib.rs")),
    ("src/main.rs", include_str!("../../template/src/main.rs")),
    ("src/task.rs", TASK),
    (".gitignore", "/target\n__pycache__\n*.so\n"),
];

/// Keywords of Rust and Python, and packages that the template uses.
const RESERVED: &str = "abstract alloc and as assert async await become box break class const continue core crate def del do dyn \
    elif else endless_gym endless_gym_agents endless_gym_python enum except extern final finally fn for from gen global gymnasium if \
    impl import in is lambda let loop macro match mod move mut nonlocal not numpy or override pass priv proc_macro pub raise ref \
    return self serde static std struct super test trait try type typeof unsafe unsized use virtual where while with yield";

/// Runs `endless new`.
pub fn run(registry: &Registry, args: &Args) -> Result<(), Failure> {
    let Args { name, path } = args;
    let type_name = type_name(name)?;
    let id = format!("{type_name}-v0");
    if registry.spec(&id).is_ok() {
        return Err(format!(
            "the environment of a crate `{name}` would have the id {id}, which exists; choose another name"
        )
        .into());
    }
    let patch = path.as_deref().map(patch).transpose()?.unwrap_or_default();
    fs::create_dir(name).map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => format!("`{name}` exists already; choose another name, or remove it"),
        _ => format!("cannot create the folder `{name}`: {error}"),
    })?;
    let filled = |text: &str| {
        text.replace("t_maze", name).replace("TMaze", &type_name).replace("VERSION", env!("CARGO_PKG_VERSION"))
    };
    for (file, text) in TEMPLATE {
        let to = Path::new(name).join(filled(file));
        let text = filled(text) + if file == "Cargo.toml" { &patch } else { "" };
        let written = fs::create_dir_all(to.parent().unwrap_or(&to)).and_then(|()| fs::write(&to, text));
        written.map_err(|error| format!("cannot write {}: {error}", to.display()))?;
    }
    print(format_args!(
        "wrote the environment {id}; next:\n\n  cd {name}\n  cargo test\n  cargo run --release -- play {id} --terminal\n\nREADME.md has more commands"
    ))
}

/// The name of the task's type, `TMaze` for `t_maze`.
fn type_name(name: &str) -> Result<String, Failure> {
    let is_word = |word: &str| !word.is_empty() && word.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit());
    if !name.starts_with(|c: char| c.is_ascii_lowercase()) || !name.split('_').all(is_word) {
        let rule = "must be words of lower-case letters and digits, joined by `_`, and begin with a letter";
        return Err(format!("the name {rule}, got `{name}`; an example is `t_maze`").into());
    }
    let word = |word: &str| word[..1].to_ascii_uppercase() + &word[1..];
    let type_name: String = name.split('_').map(word).collect();
    // The type must not hide another one.
    let is_used = |text: &str| text.split(|c: char| !c.is_ascii_alphanumeric()).any(|used| used == type_name);
    if RESERVED.split_whitespace().any(|reserved| reserved == name) || type_name != "TMaze" && is_used(TASK) {
        return Err(
            format!("the name `{name}` has a meaning in Rust, in Python or in the crate; choose another name").into()
        );
    }
    Ok(type_name)
}

/// The end of a manifest that builds with a checkout.
fn patch(checkout: &Path) -> Result<String, Failure> {
    let root = fs::canonicalize(checkout).unwrap_or_else(|_| checkout.to_owned());
    let (python, web) = (root.join("bindings/python"), root.join("bindings/web"));
    if !python.join("Cargo.toml").is_file() {
        return Err(format!("--path must be a checkout of Endless Gym, got `{}`", checkout.display()).into());
    }
    // A string of JSON is one of TOML.
    let patches = [("", root), ("-python", python), ("-web", web)]
        .map(|(end, path)| Ok(format!("endless-gym{end} = {{ path = {} }}\n", serde_json::to_string(&path)?)));
    let patches: Vec<String> = patches.into_iter().collect::<Result<_, Failure>>()?;
    Ok(format!("\n[patch.crates-io]\n{}", patches.concat()))
}

#[cfg(test)]
mod tests {
    use super::type_name;

    #[test]
    fn names_become_types_of_their_words() {
        for (name, wanted) in [("t_maze", "TMaze"), ("maze", "Maze"), ("grid_2_world", "Grid2World")] {
            assert_eq!(type_name(name).unwrap(), wanted);
        }
    }

    #[test]
    fn names_that_no_crate_or_package_can_have_are_refused() {
        for name in [
            "", "_", "a__b", "a_", "Maze", "t-maze", "2d", "../maze", "mäze", "fn", "lambda", "numpy", "task", "choice",
        ] {
            let error = type_name(name).unwrap_err().to_string();
            assert!(error.contains(&format!("`{name}`")), "{error}");
        }
    }
}
