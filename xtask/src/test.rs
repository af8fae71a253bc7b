//! `cargo xtask test`: finds out what the machine lacks, runs the stages that it can run, and reports.

use std::collections::BTreeMap;

use crate::requirements::Requirement;
use crate::runner::{self, Outcome, show};
use crate::stages::{STAGES, Stage};

/// Lines at the end of a failed stage's output that the report repeats.
const LAST_LINES: usize = 15;

/// Which stages to run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Selection {
    All,
    Quick,
    Python,
}

/// Runs the stages of a selection. With `all`, or where the environment variable CI is `true`, it is an error if something is missing.
pub fn run(selection: Selection, all: bool) -> Result<(), String> {
    let selected: Vec<&'static Stage> = STAGES.iter().filter(|stage| selection.includes(stage)).collect();
    let missing = requirements(&selected);
    let strict = all || std::env::var("CI").is_ok_and(|value| value == "true" || value == "1");
    if strict && !missing.is_empty() {
        return Err("something is missing, and all tests are to run; nothing was run".to_owned());
    }
    let lacks = |stage: &Stage| stage.requirements().into_iter().find(|requirement| missing.contains_key(requirement));
    let (not_run, to_run): (Vec<_>, Vec<_>) = selected.into_iter().partition(|stage| lacks(stage).is_some());
    let outcomes = runner::run(&to_run, selection == Selection::Quick)?;

    println!("\n{:34} {:>9}", "stage", "seconds");
    for Outcome { stage, duration, output, result, .. } in &outcomes {
        let result = if result.is_ok() { counts(output) } else { "FAILED".to_owned() };
        println!("{:34} {:>9.1}  {result}", stage.name, duration.as_secs_f64());
    }
    let skipped =
        outcomes.iter().flat_map(|outcome| outcome.output.lines()).filter(|line| line.starts_with("SKIPPED "));
    for line in skipped {
        println!("{line}");
    }
    for stage in &not_run {
        if let Some(requirement) = lacks(stage) {
            println!(
                "not run: {}, since this is missing: {}; {}",
                stage.name,
                requirement.name(),
                requirement.remedy()
            );
        }
    }
    let failed: Vec<_> =
        outcomes.iter().filter_map(|outcome| Some((outcome, outcome.result.as_ref().err()?))).collect();
    for (Outcome { stage, log, output, .. }, message) in &failed {
        println!("\nfailed: {}: {message}; {}", stage.name, show(log));
        let lines: Vec<_> = output.lines().collect();
        for line in &lines[lines.len().saturating_sub(LAST_LINES)..] {
            println!("    {line}");
        }
    }
    if failed.is_empty() {
        println!("\nall passed{}", if not_run.is_empty() { "" } else { " that could be run" });
    }
    println!("{} passed, {} failed", outcomes.len() - failed.len(), failed.len());
    if failed.is_empty() { Ok(()) } else { Err(format!("{} of {} stages failed", failed.len(), outcomes.len())) }
}

impl Selection {
    fn includes(self, stage: &Stage) -> bool {
        match self {
            Selection::All => true,
            Selection::Quick => stage.quick,
            // The package's stages and those that they are after.
            Selection::Python => {
                let is_python = |stage: &Stage| stage.requirements().contains(&Requirement::Python);
                let python = STAGES.iter().filter(|stage| is_python(stage));
                is_python(stage) || python.flat_map(|stage| stage.after).any(|name| *name == stage.name)
            }
        }
    }
}

/// Prints what the stages require and returns what is missing.
fn requirements(stages: &[&Stage]) -> BTreeMap<Requirement, String> {
    let mut all: Vec<Requirement> = stages.iter().flat_map(|stage| stage.requirements()).collect();
    all.sort();
    all.dedup();
    let mut missing = BTreeMap::new();
    for requirement in all {
        match requirement.probe() {
            Ok(found) => println!("{:52} {found}", requirement.name()),
            Err(message) => {
                println!("{:52} MISSING: {message}; {}", requirement.name(), requirement.remedy());
                missing.insert(requirement, message);
            }
        }
    }
    println!();
    missing
}

/// The tests that cargo or pytest counted in a stage's output; empty if there are none.
fn counts(output: &str) -> String {
    let mut sums = [("passed", 0), ("failed", 0), ("ignored", 0)];
    for result in output.lines().filter_map(|line| line.strip_prefix("test result: ")) {
        for (word, sum) in &mut sums {
            let part = result.split([';', '.']).find_map(|part| part.trim().strip_suffix(*word));
            *sum += part.and_then(|count| count.trim().parse::<usize>().ok()).unwrap_or(0);
        }
    }
    let [(_, passed), (_, failed), (_, ignored)] = sums;
    if passed + failed + ignored > 0 {
        return format!("{passed} passed, {failed} failed, {ignored} ignored");
    }
    let pytest = output.lines().rev().find_map(|line| {
        line.split_once(" in ").filter(|(counts, _)| counts.ends_with("passed") || counts.contains(" passed,"))
    });
    pytest.map(|(counts, _)| counts.trim_matches([' ', '=']).to_owned()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tests_are_counted() {
        let cargo = "test result: ok. 12 passed; 0 failed; 1 ignored; 0 measured; 0 filtered out; finished in 0.20s\n\
            running 1 test\n\
            test result: ok. 3 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.20s\n";
        assert_eq!(counts(cargo), "15 passed, 0 failed, 1 ignored");
        assert_eq!(counts("....\n4 passed, 2 skipped in 3.20s\n"), "4 passed, 2 skipped");
        assert_eq!(counts("====== 4 passed in 3.20s ======\n"), "4 passed");
        assert_eq!(counts("    Finished `dev` profile\n"), "");
    }

    #[test]
    fn the_stages_of_python_are_complete() {
        let selected: Vec<_> = STAGES.iter().filter(|stage| Selection::Python.includes(stage)).collect();
        assert!(selected.iter().any(|stage| stage.name == "pytest"));
        assert!(
            selected
                .iter()
                .all(|stage| stage.after.iter().all(|name| selected.iter().any(|other| other.name == *name)))
        );
        assert!(selected.iter().all(|stage| stage.name != "clippy"));
    }
}
