//! Development tasks: `cargo xtask test` runs all tests.

mod cargo;
mod instructions;
mod modules;
mod original;
mod python;
mod test;
mod venv;
mod wasm;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Development tasks of Endless Gym.
#[derive(Parser)]
#[command(bin_name = "cargo xtask")]
struct Cli {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Check formatting, lint, and run all tests, Rust's and Python's.
    Test,
    /// Build the Python package, lint it, and run its tests alone.
    Python,
    /// Check that the files of a crate do not import each other in cycles.
    Modules,
    /// Build the core for wasm32-unknown-unknown.
    Wasm,
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
    /// Set up the original in a virtual environment and print the path of its Python.
    Original,
}

impl Task {
    fn run(&self) -> Result<(), String> {
        match self {
            Task::Test => test::run(),
            Task::Python => python::test(),
            Task::Modules => modules::check(),
            Task::Wasm => wasm::build(),
            Task::Instructions { record } => instructions::run(*record),
            Task::Bench { arguments } => python::bench(arguments),
            Task::Live { steps } => cargo::live(*steps),
            Task::Properties { cases } => cargo::properties(*cases),
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
