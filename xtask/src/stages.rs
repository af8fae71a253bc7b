//! The stages of `cargo xtask test`.

use crate::requirements::Requirement::{self, *};
use crate::{cargo, docs, faults, files, instructions, modules, original, packages, python, wasm, web};

/// One part of the tests.
#[derive(Debug)]
pub struct Stage {
    pub name: &'static str,
    pub run: fn() -> Result<(), String>,
    /// What it requires beside the requirements of the stages in `after`.
    pub needs: &'static [Requirement],
    /// The stages that it can only run after.
    pub after: &'static [&'static str],
    /// Whether cargo compiles much of it: cargo compiles for one command at a time.
    pub compiles: bool,
    /// Whether it is part of `cargo xtask test --quick`.
    pub quick: bool,
}

/// All tests of the workspace, by one command line up to here: another selection of targets would compile dependencies again.
const RUST_TESTS: &[&str] = &["test", "--workspace", "--locked", "--no-fail-fast", "--"];

/// The tests that take more than some seconds.
const SLOW: &[&str] = &[
    "deaths_at_any_moment_are_survived",
    "drawn_alike_in_irregular_buffers",
    "every_format_is_a_plain_conversion",
    "finite_searing_spotlights_is_solved",
    "steps_and_resets_allocate_nothing",
];

const STAGE: Stage = Stage { name: "", run: || Ok(()), needs: &[], after: &[], compiles: false, quick: false };
const QUICK: Stage = Stage { quick: true, ..STAGE };

/// In the order in which they start where nothing else decides: what is waited for first.
pub const STAGES: &[Stage] = &[
    Stage { name: "format", run: || cargo::run(&["fmt", "--all", "--check"]), ..QUICK },
    Stage { name: "python environment", run: || python::environment().map(drop), needs: &[Python, Disk], ..QUICK },
    Stage {
        name: "rust build",
        run: || cargo::run(&["test", "--workspace", "--locked", "--no-run"]),
        needs: &[Linker, Disk],
        compiles: true,
        ..QUICK
    },
    Stage { name: "import cycles", run: modules::check, ..QUICK },
    Stage {
        name: "wheel",
        run: || python::install("dev"),
        after: &["python environment", "rust build"],
        compiles: true,
        ..QUICK
    },
    Stage {
        name: "rust tests",
        run: || cargo::run(RUST_TESTS),
        after: &["rust build"],
        needs: &[SharedMemory],
        ..QUICK
    },
    Stage {
        name: "clippy",
        run: || {
            cargo::run(&["clippy", "--workspace", "--all-targets", "--locked", "--", "--deny", "warnings"])?;
            let core = ["--package", "endless-gym-core", "--no-default-features", "--locked"];
            cargo::run(&[&["clippy"], core.as_slice(), &["--", "--deny", "warnings"]].concat())
        },
        needs: &[Linker],
        compiles: true,
        ..QUICK
    },
    Stage {
        name: "original environment",
        run: || original::python().map(drop),
        needs: &[OriginalPython, Disk],
        ..STAGE
    },
    Stage {
        name: "libraries environment",
        run: || python::libraries().map(drop),
        after: &["python environment"],
        ..STAGE
    },
    Stage { name: "ruff", run: python::ruff, after: &["python environment"], ..QUICK },
    Stage { name: "mypy", run: python::mypy, after: &["python environment"], ..QUICK },
    Stage {
        name: "pytest",
        run: || python::pytest("not slow and not original"),
        after: &["wheel"],
        needs: &[SharedMemory],
        ..QUICK
    },
    Stage {
        name: "rust tests slow",
        run: || cargo::run(&[RUST_TESTS, &["--ignored"], SLOW].concat()),
        after: &["rust build"],
        needs: &[SharedMemory],
        ..STAGE
    },
    Stage {
        name: "pytest slow",
        run: || python::pytest("slow and not original"),
        after: &["wheel", "libraries environment"],
        needs: &[SharedMemory],
        ..STAGE
    },
    Stage { name: "files", run: files::check, needs: &[Python, Disk], ..QUICK },
    Stage {
        name: "packages",
        run: packages::test,
        after: &["wheel"],
        needs: &[SharedMemory, Linker, Disk],
        compiles: true,
        ..STAGE
    },
    Stage {
        name: "instructions",
        run: || instructions::run(false),
        needs: &[Linker, Valgrind, Disk],
        compiles: true,
        ..STAGE
    },
    Stage {
        name: "documentation",
        run: || docs::build(false),
        after: &["rust build"],
        needs: &[Linker, Python, Disk],
        compiles: true,
        ..STAGE
    },
    Stage { name: "loom", run: cargo::loom, needs: &[Linker, Disk], compiles: true, ..STAGE },
    Stage { name: "wasm", run: wasm::build, needs: &[Linker, Wasm], compiles: true, ..STAGE },
    Stage {
        name: "web",
        run: web::test,
        needs: &[Browser, SharedMemory],
        after: &["rust build", "wasm"],
        compiles: true,
        ..STAGE
    },
    Stage {
        name: "shared memory of other sizes",
        run: || {
            cargo::ignored_test("integration", "service::too_little_shared_memory_is_an_error_and_not_a_signal")?;
            cargo::ignored_test(
                "integration",
                "service_faults::inside_full_shared_memory_an_engine_reports_it_and_leaves_nothing",
            )?;
            cargo::ignored_test(
                "integration",
                "service_faults::inside_memory_that_dead_processes_fill_an_engine_starts",
            )?;
            cargo::ignored_test(
                "integration",
                "service_faults::inside_small_shared_memory_observers_get_what_is_left",
            )?;
            cargo::ignored_test("integration", "service_faults::two_directories_of_one_path_share_nothing")
        },
        needs: &[MountNamespaces],
        after: &["rust build"],
        ..STAGE
    },
    Stage {
        name: "segments of another user",
        run: || {
            cargo::ignored_test(
                "integration",
                "service_faults::as_root_a_segment_of_another_user_is_reported_or_avoided",
            )
        },
        needs: &[Root],
        after: &["rust build"],
        ..STAGE
    },
    Stage {
        name: "faults",
        run: faults::test,
        // It leaves out what needs mount namespaces or another user where they are missing.
        needs: &[SharedMemory],
        after: &["rust build"],
        compiles: true,
        ..STAGE
    },
    Stage {
        name: "live comparison with the original",
        run: || cargo::run(&["test", "--locked", "--test", "integration", "--", "--include-ignored", "live::"]),
        after: &["rust build", "original environment"],
        ..STAGE
    },
    Stage {
        name: "pytest with the original",
        run: python::pytest_original,
        after: &["wheel", "original environment"],
        needs: &[SharedMemory],
        ..STAGE
    },
];

/// The stage of that name.
pub fn find(name: &str) -> Result<&'static Stage, String> {
    STAGES.iter().find(|stage| stage.name == name).ok_or_else(|| {
        let names: Vec<_> = STAGES.iter().map(|stage| format!("`{}`", stage.name)).collect();
        format!("no stage `{name}`; the stages are {}", names.join(", "))
    })
}

impl Stage {
    /// All that it and the stages before it require.
    pub fn requirements(&self) -> Vec<Requirement> {
        let before = self.after.iter().filter_map(|name| find(name).ok()).flat_map(Stage::requirements);
        let mut all: Vec<Requirement> = self.needs.iter().copied().chain(before).collect();
        all.sort();
        all.dedup();
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_are_after_earlier_ones_and_quick_ones_after_quick_ones() {
        for (position, stage) in STAGES.iter().enumerate() {
            assert_eq!(STAGES.iter().position(|other| other.name == stage.name), Some(position), "{}", stage.name);
            for name in stage.after {
                let before = STAGES[..position].iter().find(|other| other.name == *name);
                let before = before.unwrap_or_else(|| panic!("{}: no stage `{name}` before it", stage.name));
                assert!(before.quick || !stage.quick, "{} is quick, {name} is not", stage.name);
            }
        }
    }

    #[test]
    fn a_stage_requires_what_the_stages_before_it_require() {
        let live = find("live comparison with the original").unwrap();
        assert_eq!(live.requirements(), [Linker, OriginalPython, Disk]);
    }
}
