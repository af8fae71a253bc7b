//! The program `endless`: thin layers over the library. It is here so that the Python package brings it along.

mod bench;
mod demo;
mod engine_process;
mod list;
mod options;
mod output;
mod play;
mod serve;
mod stop;
mod verify;

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// The Memory Gym environments, bit for bit, at memory speed, in shared memory.
///
/// Without a command: the demo.
#[derive(Parser)]
#[command(name = "endless", version, about, max_term_width = 110)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Subcommand)]
enum Command {
    /// Show the environments, or one of them with its spaces and reset parameters.
    List(list::Args),
    /// Start an engine and a trainer that plays through shared memory, and show how fast and how well.
    Demo(demo::Args),
    /// Serve environments in shared memory until Ctrl-C.
    Serve(serve::Args),
    /// Measure steps per second, in process and through shared memory.
    Bench(bench::Args),
    /// Replay recorded traces of the original and compare every observation, reward, flag and info.
    Verify(verify::Args),
}

/// What any command may fail with: it is shown as one line.
type Failure = Box<dyn std::error::Error>;

/// Runs the program with these arguments. `itself` is the command that starts the program anew, for commands that run an engine
/// in a process of its own.
pub fn main(arguments: impl IntoIterator<Item = OsString>, itself: &[OsString]) -> ExitCode {
    engine_process::set_program(itself);
    let arguments = std::iter::once("endless".into()).chain(arguments);
    let command = Cli::parse_from(arguments).command.unwrap_or_else(|| Command::Demo(demo::Args::default()));
    let done = match command {
        Command::List(args) => list::run(&args),
        Command::Demo(args) => demo::run(&args),
        Command::Serve(args) => serve::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::Verify(args) => verify::run(&args),
    };
    done.unwrap_or_else(|error| {
        eprintln!("endless: {error}");
        ExitCode::FAILURE
    })
}
