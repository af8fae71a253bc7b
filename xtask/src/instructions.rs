//! Instructions of a step against recorded budgets: unlike times, they do not depend on the load of the machine.

use std::fmt::Write;
use std::path::PathBuf;

use crate::cargo;
use crate::venv::workspace;

/// Environment steps that `benches/instructions.rs` counts.
const STEPS: u64 = 250 * 16;

/// Allowed deviation: processors of other kinds copy memory with other instructions.
const MARGIN_PERCENT: u64 = 10;

/// Settings of the C library's `memcpy` and `memset`: no `rep movsb` and `rep stosb`, of which callgrind counts every byte as an
/// instruction.
const NO_REPEATED_MOVES: &str =
    "glibc.cpu.x86_rep_movsb_threshold=1000000000:glibc.cpu.x86_rep_stosb_threshold=1000000000";

/// Counts and compares with the budgets; with `record`, writes the counts as the new budgets.
pub fn run(record: bool) -> Result<(), String> {
    let file = budgets_file();
    let text = std::fs::read_to_string(&file).map_err(|error| format!("{}: {error}", file.display()))?;
    let mut recorded = String::new();
    let mut failures = Vec::new();
    println!("{:30} {:>24} {:>8}", "environment", "instructions a step", "budget");
    for line in text.lines() {
        let (id, budget) = line.split_once(' ').unwrap_or((line, "0"));
        let budget: u64 = budget.parse().map_err(|error| format!("{}: {line}: {error}", file.display()))?;
        let count = count(id)? / STEPS;
        println!("{id:30} {count:24} {budget:8}");
        let _ = writeln!(recorded, "{id} {count}");
        if count.abs_diff(budget) * 100 > budget * MARGIN_PERCENT {
            failures.push(format!("{id}: {count} instructions a step, the budget is {budget} ± {MARGIN_PERCENT} %"));
        }
    }
    if record {
        return std::fs::write(&file, recorded).map_err(|error| format!("{}: {error}", file.display()));
    }
    if failures.is_empty() {
        return Ok(());
    }
    failures.push("if the change is intended, record it: cargo xtask instructions --record".to_owned());
    Err(failures.join("\n"))
}

fn budgets_file() -> PathBuf {
    workspace().join("benches/instructions.txt")
}

/// Instructions of all counted steps of an environment, measured by callgrind.
fn count(id: &str) -> Result<u64, String> {
    const VALGRIND: &str =
        "valgrind --tool=callgrind --callgrind-out-file=/dev/null --toggle-collect=instructions::steps";
    let target = format!("CARGO_TARGET_{}_RUNNER", env!("TARGET").to_uppercase().replace('-', "_"));
    let output = cargo::command()
        .args(["bench", "--locked", "--package", "endless-gym", "--bench", "instructions", "--", id])
        .env(target, VALGRIND)
        .env("GLIBC_TUNABLES", NO_REPEATED_MOVES)
        .output()
        .map_err(|error| format!("cargo bench cannot be run: {error}"))?;
    let printed = String::from_utf8_lossy(&output.stderr);
    let collected = printed.lines().find_map(|line| line.split_once("Collected :")).map(|(_, count)| count.trim());
    match collected.and_then(|count| count.parse().ok()) {
        Some(count) if count > 0 && output.status.success() => Ok(count),
        _ => Err(format!("callgrind counted no instructions of {id}; is valgrind installed?\n{printed}")),
    }
}
