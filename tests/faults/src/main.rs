//! Fault injection with real processes: an engine, its trainer, observers and visitors are killed, stopped and starved
//! in a sequence derived from a seed, and the trainer compares every byte that it receives with a pool in its own
//! process. Runs of `endless learn` are killed and continued.

mod actors;
mod checker;
mod cleanliness;
mod event;
mod faults;
mod learner;
mod ledger;
mod options;
mod others;
mod page;
mod plan;
mod report;
mod rights;
mod round;
mod run;
mod scene;
mod shape;
mod soak;
mod trainer;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Fault injection with real processes, and long runs.
#[derive(Parser)]
#[command(name = "endless-gym-faults", bin_name = "cargo xtask", version)]
struct Cli {
    #[command(subcommand)]
    command: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Kill, stop and starve processes, and check every byte.
    Faults(run::Args),
    /// Play all environments with random options for a long time, and watch memory, descriptors and files.
    Soak(soak::Args),
    /// Play one round in the namespace of the environment variable, and print its outcome as JSON.
    #[command(hide = true)]
    Round { seed: u64, number: u64 },
    /// Take part in a round.
    #[command(hide = true)]
    Role { name: String, argument: String },
}

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Task::Faults(args) => run::run(&args),
        Task::Soak(args) => soak::run(&args),
        Task::Round { seed, number } => run::round(seed, number),
        Task::Role { name, argument } => role(&name, &argument),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("{message}");
            ExitCode::FAILURE
        }
    }
}

fn role(name: &str, argument: &str) -> Result<(), String> {
    fn parsed<T: serde::de::DeserializeOwned>(argument: &str) -> Result<T, String> {
        serde_json::from_str(argument).map_err(|error| error.to_string())
    }
    match name {
        "train" => return trainer::run(&parsed(argument)?),
        "observe" => others::observe(&parsed(argument)?),
        "show" => return page::show(),
        "visit" => {
            let (seed, times) = parsed(argument)?;
            others::visit(seed, times);
        }
        "intrude" => others::intrude(),
        _ => return Err(format!("unknown role {name}")),
    }
    Ok(())
}
