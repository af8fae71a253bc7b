//! Development tasks: `cargo xtask test` runs all tests.

mod cargo;
mod dist;
mod docs;
mod faults;
mod files;
mod instructions;
mod interpreters;
mod modules;
mod original;
mod packages;
mod paths;
mod pictures;
mod python;
mod requirements;
mod runner;
mod stages;
mod test;
mod venv;
mod wasm;
mod web;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::test::Selection;

/// Development tasks of Endless Gym.
#[derive(Parser)]
#[command(bin_name = "cargo xtask")]
struct Cli {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Check formatting, lint, and run all tests, Rust's and Python's, in stages side by side.
    ///
    /// Prints first what the machine lacks; the stages that require it are not run. The output of a stage is in target/test-logs.
    Test {
        /// The stages of every day, some minutes long: without the long tests and what needs further tools.
        #[arg(long)]
        quick: bool,
        /// Run nothing if something is missing; the default where the environment variable CI is `true`.
        #[arg(long)]
        all: bool,
    },
    /// Build the Python package, lint it, and run its tests alone.
    Python,
    /// Run one stage of the tests.
    Stage {
        /// Its name in the report of `cargo xtask test`.
        name: String,
    },
    /// Check that the files of a crate do not import each other in cycles.
    Modules,
    /// Build the documentation, with its links and generated tables checked, into target/site.
    Docs {
        /// Write the generated tables into the pages instead of checking them.
        #[arg(long)]
        write: bool,
    },
    /// Check the files that no compiler reads: workflows, forms, scripts, versions, licences.
    Files,
    /// Build what a release consists of into target/dist: wheel, source distribution, crates.
    Dist,
    /// Build them, install them on each CPython there is, and use them.
    Packages,
    /// Make the pictures of the documentation again, in docs/images.
    Pictures,
    /// Build the core for wasm32-unknown-unknown.
    Wasm,
    /// Build the page that plays the environments in a browser into target/web.
    Web,
    /// Count the instructions of a step and compare with the budgets.
    Instructions {
        /// Write the counts as the new budgets.
        #[arg(long)]
        record: bool,
    },
    /// Compare steps per second with the original's and others'.
    #[command(disable_help_flag = true)]
    Bench {
        /// Arguments of benches/comparison.py; `--help` lists them.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Kill, stop and starve engines, trainers and observers at random, and compare every byte.
    #[command(disable_help_flag = true)]
    Faults {
        /// Arguments, such as `--minutes 10 --seed 1`; `--help` lists them.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Play all environments with random options for an hour, and watch memory and descriptors.
    #[command(disable_help_flag = true)]
    Soak {
        /// Arguments, such as `--minutes 10`; `--help` lists them.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Compare with the original from new seeds.
    Live {
        /// Steps to compare for each environment.
        #[arg(default_value_t = 100_000)]
        steps: u64,
    },
    /// Run the property tests from new seeds.
    Properties {
        /// Cases of each property.
        #[arg(default_value_t = 2000)]
        cases: u32,
    },
    /// Run the fuzz targets from new seeds, as property tests.
    Fuzz {
        /// One of the targets: actions, checkpoints, layouts, options, snapshots, traces.
        target: Option<String>,
        /// How long; every target is run at least once.
        #[arg(long, default_value_t = 1)]
        minutes: u64,
    },
    /// Check the models of the worker threads under loom.
    Loom,
    /// Set up the original in a virtual environment and print the path of its Python.
    Original,
}

impl Task {
    fn run(&self) -> Result<(), String> {
        match self {
            Task::Test { quick: true, all } => test::run(Selection::Quick, *all),
            Task::Test { quick: false, all } => test::run(Selection::All, *all),
            Task::Python => test::run(Selection::Python, false),
            Task::Stage { name } => (stages::find(name)?.run)(),
            Task::Modules => modules::check(),
            Task::Docs { write } => docs::build(*write),
            Task::Files => files::check(),
            Task::Dist => dist::build(),
            Task::Packages => packages::test(),
            Task::Pictures => pictures::make(),
            Task::Wasm => wasm::build(),
            Task::Web => web::build(),
            Task::Instructions { record } => instructions::run(*record),
            Task::Bench { arguments } => python::bench(arguments),
            Task::Faults { arguments } => faults::run("faults", arguments),
            Task::Soak { arguments } => faults::run("soak", arguments),
            Task::Live { steps } => cargo::live(*steps),
            Task::Properties { cases } => cargo::properties(*cases),
            Task::Fuzz { target, minutes } => cargo::fuzz(target.as_deref(), *minutes),
            Task::Loom => cargo::loom(),
            Task::Original => original::python().map(|python| println!("{}", python.display())),
        }
    }
}

fn main() -> ExitCode {
    match Cli::parse().task.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("xtask: {message}");
            ExitCode::FAILURE
        }
    }
}
