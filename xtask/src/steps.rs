//! The steps of `cargo xtask test`, in the order in which they run.

use std::process::Command;
use std::time::Instant;

use crate::shell::succeeds;
use crate::{docs, files, python, release, rust, web};

/// One part of the tests.
pub struct Step {
    pub name: &'static str,
    /// Whether only `cargo xtask test --all` runs it.
    rest: bool,
    run: fn() -> Result<(), String>,
    /// What it requires besides Rust, a linker and CPython.
    needs: &'static [Need],
}

/// What a machine may lack.
struct Need {
    is_met: fn() -> bool,
    /// What it is and how to get it.
    what: &'static str,
}

const ORIGINAL_PYTHON: Need = Need {
    is_met: || python::interpreter(python::ORIGINAL).is_some(),
    what: "CPython 3.11; apt-get install python3.11 python3.11-venv, or pyenv install 3.11",
};
const VALGRIND: Need =
    Need { is_met: || succeeds(Command::new("valgrind").arg("--version")), what: "valgrind; apt-get install valgrind" };
const WASM: Need = Need { is_met: || web::Toolchain::find().is_some(), what: web::MISSING };
const BROWSER: Need = Need {
    is_met: web::has_browser,
    what: "Chromium; apt-get install chromium, or set CHROMIUM to the program's path",
};

const NPM: Need = Need { is_met: || succeeds(Command::new("npm").arg("--version")), what: "npm; apt-get install npm" };

const fn step(name: &'static str, rest: bool, needs: &'static [Need], run: fn() -> Result<(), String>) -> Step {
    Step { name, rest, run, needs }
}

const STEPS: &[Step] = &[
    step("format", false, &[], rust::format),
    step("rust-tests", false, &[], rust::test),
    step("clippy", false, &[], rust::clippy),
    step("import-cycles", false, &[], python::cycles),
    step("python-lint", false, &[], python::lint),
    step("python-tests", false, &[], python::test),
    step("files", true, &[], files::check),
    step("rust-ignored", true, &[], rust::test_ignored),
    step("faults", true, &[], rust::test_faults),
    step("instructions", true, &[VALGRIND], || rust::instructions(false)),
    step("loom", true, &[], rust::loom),
    step("browser", true, &[WASM, BROWSER, NPM], web::test),
    step("documentation", true, &[], || docs::build(false)),
    step("rust-original", true, &[ORIGINAL_PYTHON], || rust::test_original(None)),
    step("python-original", true, &[ORIGINAL_PYTHON], python::test_original),
    step("libraries", true, &[], || python::test_libraries(release::crates()?)),
    step("agents", true, &[], python::test_agents),
    step("packages", true, &[], release::test),
];

/// Prints the names of all steps.
pub fn list() -> Result<(), String> {
    STEPS.iter().for_each(|step| println!("{}{}", step.name, if step.rest { " (--all)" } else { "" }));
    Ok(())
}

/// Runs the steps in `only`; if it is empty, the first ones, or with `all` the rest. Stops at the first failure unless
/// `keep_going`.
///
/// A step whose needs are not met is skipped; if the environment variable CI is `true`, that is a failure.
pub fn run(only: &[String], all: bool, keep_going: bool) -> Result<(), String> {
    if let Some(unknown) = only.iter().find(|name| STEPS.iter().all(|step| step.name != *name)) {
        return Err(format!("no step `{unknown}`; `cargo xtask test --list` lists them"));
    }
    let is_selected =
        |step: &&Step| if only.is_empty() { step.rest == all } else { only.iter().any(|name| name == step.name) };
    let mut report = String::new();
    let mut failed = 0;
    for step in STEPS.iter().filter(is_selected) {
        println!("\n==> step {}", step.name);
        let start = Instant::now();
        let missing = step.needs.iter().find(|need| !(need.is_met)()).map(|need| need.what);
        let result = missing.map_or_else(step.run, |missing| match std::env::var("CI").as_deref() {
            Ok("true") => Err(format!("missing: {missing}")),
            _ => Ok(()),
        });
        let text = match (&result, missing) {
            (Ok(()), None) => "passed".to_owned(),
            (Ok(()), Some(missing)) => format!("not run: {missing}"),
            (Err(message), _) => format!("FAILED: {message}"),
        };
        report += &format!("{:16} {:>7.1} s  {text}\n", step.name, start.elapsed().as_secs_f64());
        failed += usize::from(result.is_err());
        if failed > 0 && !keep_going {
            break;
        }
    }
    println!("\n{report}");
    if failed == 0 { Ok(()) } else { Err(format!("{failed} failed; repeat one with `cargo xtask test --only STEP`")) }
}
