//! The steps of `cargo xtask test`, in the order in which they run.

use std::time::Instant;

use crate::shell::has;
use crate::{docs, files, python, release, rust, web};

/// One part of the tests: its name, whether only `cargo xtask test --all` runs it, what it requires besides Rust, a linker and CPython,
/// and its function.
struct Step(&'static str, bool, &'static [Need], fn() -> Result<(), String>);

/// What a machine may lack: whether it is there, and what it is and how to get it.
type Need = (fn() -> bool, &'static str);

const ORIGINAL_PYTHON: Need = (
    || python::interpreter(python::ORIGINAL).is_some(),
    "CPython 3.11; apt-get install python3.11 python3.11-venv, or pyenv install 3.11",
);
const VALGRIND: Need = (|| has("valgrind"), "valgrind; apt-get install valgrind");
const WASM: Need = (|| web::Toolchain::find().is_some(), web::MISSING);
const BROWSER: Need = (web::has_browser, "Chromium; apt-get install chromium, or set CHROMIUM to the program's path");
const NPM: Need = (|| has("npm"), "npm; apt-get install npm");

const STEPS: &[Step] = &[
    Step("format", false, &[], rust::format),
    Step("rust-tests", false, &[], rust::test),
    Step("clippy", false, &[], rust::clippy),
    Step("import-cycles", false, &[], python::cycles),
    Step("python-lint", false, &[], python::lint),
    Step("python-tests", false, &[], python::test),
    Step("files", true, &[], files::check),
    Step("clippy-features", true, &[], rust::clippy_features),
    Step("rust-ignored", true, &[], rust::test_ignored),
    Step("faults", true, &[], || rust::faults("faults", &["--minutes", "1", "--seed", "1"])),
    Step("instructions", true, &[VALGRIND], || rust::instructions(false)),
    Step("loom", true, &[], rust::loom),
    Step("browser", true, &[WASM, BROWSER, NPM], web::test),
    Step("documentation", true, &[], || docs::build(false)),
    Step("rust-original", true, &[ORIGINAL_PYTHON], || rust::test_original(None)),
    Step("python-original", true, &[ORIGINAL_PYTHON], python::test_original),
    Step("libraries", true, &[], || python::test_libraries(release::crates()?)),
    Step("agents", true, &[], python::test_agents),
    Step("packages", true, &[], release::test),
];

/// Prints the names of all steps.
pub fn list() -> Result<(), String> {
    STEPS.iter().for_each(|Step(name, rest, ..)| println!("{name}{}", if *rest { " (--all)" } else { "" }));
    Ok(())
}

/// Runs the steps in `only`; if it is empty, the first ones, or with `all` the rest. Stops at the first failure unless
/// `keep_going`.
///
/// A step whose needs are not met is skipped; if the environment variable CI is `true`, that is a failure.
pub fn run(only: &[String], all: bool, keep_going: bool) -> Result<(), String> {
    if let Some(unknown) = only.iter().find(|name| STEPS.iter().all(|step| step.0 != *name)) {
        return Err(format!("no step `{unknown}`; `cargo xtask test --list` lists them"));
    }
    let selected = |step: &&Step| if only.is_empty() { step.1 == all } else { only.iter().any(|name| name == step.0) };
    let (mut report, mut failed) = (String::new(), 0);
    for Step(name, _, needs, step) in STEPS.iter().filter(selected) {
        println!("\n==> step {name}");
        let start = Instant::now();
        let missing = needs.iter().find(|(is_met, _)| !is_met()).map(|(_, what)| what);
        let result = missing.map_or_else(step, |missing| rust::not_run(&format!("since it lacks {missing}")));
        let text = match (&result, missing) {
            (Ok(()), None) => "passed".to_owned(),
            (Ok(()), Some(missing)) => format!("not run: {missing}"),
            (Err(message), _) => format!("FAILED: {message}"),
        };
        report += &format!("{name:16} {:>7.1} s  {text}\n", start.elapsed().as_secs_f64());
        failed += usize::from(result.is_err());
        if failed > 0 && !keep_going {
            break;
        }
    }
    println!("\n{report}");
    if failed == 0 { Ok(()) } else { Err(format!("{failed} failed; repeat one with `cargo xtask test --only STEP`")) }
}
