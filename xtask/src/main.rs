//! Development tasks: `cargo xtask test` runs all tests.

mod docs;
mod files;
mod python;
mod release;
mod rust;
mod shell;
mod steps;
mod web;

use std::process::ExitCode;

use clap::Parser;

/// Development tasks of Endless Gym.
#[derive(Parser)]
#[command(bin_name = "cargo xtask")]
enum Task {
    /// Check formatting, run lints, and run the tests that need only Rust, a linker and CPython.
    Test {
        /// Run the remaining steps instead: those that take long, or need further tools, third-party libraries or the original.
        #[arg(long)]
        all: bool,
        /// Run only these steps.
        #[arg(long, value_name = "STEP", conflicts_with = "all")]
        only: Vec<String>,
        /// Do not stop at the first failure.
        #[arg(long)]
        keep_going: bool,
        /// List the steps.
        #[arg(long)]
        list: bool,
    },
    /// Build the documentation into target/site, and check its links and generated tables.
    Docs {
        /// Write the generated tables into the pages instead of checking them.
        #[arg(long)]
        write: bool,
    },
    /// Build the files of a release into target/dist: wheel, source distribution, crates.
    Dist,
    /// Regenerate the pictures of the documentation in docs/images.
    Pictures,
    /// Build the page that plays the environments in a browser into target/web.
    Web,
    /// Build the page and a program that includes it, and open it in a browser.
    #[command(disable_help_flag = true)]
    Play(Arguments),
    /// Count the instructions of a step and compare them with the budgets.
    Instructions {
        /// Write the counts as the new budgets.
        #[arg(long)]
        record: bool,
    },
    /// Compare steps per second with the original.
    #[command(disable_help_flag = true)]
    Bench(Arguments),
    /// Kill, stop and starve engines, trainers and observers at random, and compare every byte.
    #[command(disable_help_flag = true)]
    Faults(Arguments),
    /// Play all environments with random options for an hour, and watch memory and descriptors.
    #[command(disable_help_flag = true)]
    Soak(Arguments),
    /// Compare with the original, with new seeds.
    Live {
        /// Steps to compare for each environment.
        #[arg(default_value_t = 100_000)]
        steps: u64,
    },
    /// Run the fuzz targets as property tests, with new seeds.
    Fuzz {
        /// A target: actions, checkpoints, options, snapshots or traces [default: all].
        target: Option<String>,
        /// Duration in minutes; every target runs at least once.
        #[arg(long, default_value_t = 1)]
        minutes: u64,
    },
    /// Set up the originals, each in a virtual environment, and print the paths of their Pythons, separated by a comma.
    Original {
        /// Only this one: memory-gym or popgym.
        #[arg(value_parser = ["memory-gym", "popgym"])]
        only: Option<String>,
    },
}

/// Arguments of the program that a task runs; `--help` lists them.
#[derive(clap::Args)]
struct Arguments {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    arguments: Vec<String>,
}

fn main() -> ExitCode {
    let result = match Task::parse() {
        Task::Test { list: true, .. } => steps::list(),
        Task::Test { all, only, keep_going, .. } => steps::run(&only, all, keep_going),
        Task::Docs { write } => docs::build(write),
        Task::Dist => release::build(),
        Task::Pictures => python::pictures(),
        Task::Web => web::build(),
        Task::Play(Arguments { arguments }) => web::play(&arguments),
        Task::Instructions { record } => rust::instructions(record),
        Task::Bench(Arguments { arguments }) => python::bench(&arguments),
        Task::Faults(Arguments { arguments }) => rust::faults("faults", &arguments),
        Task::Soak(Arguments { arguments }) => rust::faults("soak", &arguments),
        Task::Live { steps } => rust::test_original(Some(steps)),
        Task::Fuzz { target, minutes } => rust::fuzz(target.as_deref(), minutes),
        Task::Original { only } => {
            let names =
                ["memory-gym", "popgym"].into_iter().filter(|name| only.as_ref().is_none_or(|only| only == name));
            let paths = names.map(|name| Ok(python::original(name == "popgym")?.display().to_string()));
            paths.collect::<Result<Vec<_>, _>>().map(|paths| println!("{}", paths.join(",")))
        }
    };
    let Err(message) = result else { return ExitCode::SUCCESS };
    eprintln!("xtask: {message}");
    ExitCode::FAILURE
}
