//! The command line program `endless`, as a library: the binary of the crate `endless-gym` and the Python package both run [`main`].

#![expect(clippy::missing_errors_doc, reason = "one line says what a section would")]

mod commands;
mod engine_process;
mod failure;
mod film;
mod huge_pages;
mod logs;
mod open;
mod options;
mod output;
mod picture;
mod policies;
mod stop;
mod terminal;

use std::ffi::OsString;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use endless_gym_core::pool::Registry;
use endless_gym_service::Namespace;
use endless_gym_trainer::settings::{self, Settings};
use nix::sys::signal::{SigSet, Signal};

pub use film::file as film_file;

use commands::{bench, check, demo, learn, list, new, page, play, record, scaling, serve, status, verify, view};
use failure::Failure;

/// Environments for reinforcement learning in lockstep, in process and in shared memory.
///
/// Without a command, `endless` runs `endless demo`. The environment variable ENDLESS_GYM_ROOT names the directory in which engines
/// and trainers find each other [default: /tmp/endless-gym-UID, with the number of the user].
#[derive(Parser)]
#[command(name = "endless", version, about, max_term_width = 110)]
struct Cli {
    /// What to log to standard error: off, error, warn, info, debug, trace, or a filter such as `endless_gym_service=debug`
    /// [default: the environment variable ENDLESS_GYM_LOG, or warn].
    #[arg(long, value_name = "LEVEL", global = true)]
    log: Option<String>,
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Subcommand)]
enum Command {
    /// List the environments, or describe one: spaces, reset parameters, info and features.
    List(list::Args),
    /// Play through shared memory with an engine in a child process, and report speed and returns.
    Demo(demo::Args),
    /// Serve environments in shared memory until Ctrl-C.
    Serve(serve::Args),
    /// Show what the running engines are doing, without disturbing them, or follow one.
    Status(status::Args),
    /// Show the environments of a running engine in a browser on this machine or in the terminal.
    View(view::Args),
    /// Play an environment in a browser on this machine or in the terminal.
    Play(play::Args),
    /// Record episodes of scripted experts or random actions as a film or, with the Python package, a Minari data set.
    #[command(disable_help_flag = true)]
    Record(record::Args),
    /// Measure steps per second in process and through shared memory.
    ///
    /// Actions are random, and resets are included. Each round measures every method once. The result is the median
    /// over the rounds, since other programs on the machine disturb single measurements.
    Bench(bench::Args),
    /// Train an agent with a memory by PPO, from the features of the environments.
    ///
    /// The settings are those of the Python agents, whose tools evaluate and plot the run. `--no-NAME` stands for `--NAME=false`.
    Learn(Box<Settings>),
    /// Replay recorded episodes of a reference implementation, and compare every observation, reward, flag and info.
    Verify(verify::Args),
    /// Check environments with random actions: seeds, snapshots, frames, spaces, limits of reset parameters.
    Check(check::Args),
    /// Write a crate with an environment of your own: its task, its tests, its program and its Python package.
    New(new::Args),
    /// Write the page that plays the environments of your crate in a browser, for any web server.
    Page(page::Args),
    /// Remove what dead processes left in the namespace. The status is that of a failure, as the process was one that failed.
    #[command(hide = true)]
    Clean,
}

/// Exit status of a command that failed or found differences.
const FAILURE: u8 = 1;

/// Runs the program `endless` with the environments of `registry` and returns its exit status.
///
/// `arguments` are the arguments without the program's name. `executable` is the command, with its first arguments,
/// with which `demo` and `bench` start the program in a new process as an engine. Only the first call in a process sets
/// it.
///
/// The status is 0 on success; 1 after an error, which is printed to standard error as one line, or if `verify` finds a
/// difference; 2 if the arguments are invalid. Output that cannot be written is an error, but a closed pipe is not.
///
/// If the process has no `tracing` subscriber yet, the first call installs one that logs to standard error.
///
/// `demo`, `serve`, `status`, `play`, `view`, `record` and `bench` install handlers for SIGINT, SIGTERM and SIGHUP,
/// which stay installed. The first signal stops the command, and a second one ends the process at once. Do not run two
/// of these commands at the same time in one process: they share one stop flag, which a signal sets and a starting
/// command clears.
pub fn main(registry: &Registry, arguments: impl IntoIterator<Item = OsString>, executable: &[OsString]) -> u8 {
    engine_process::set_executable(executable);
    // A file that grows beyond the limit of its size is an error, instead of the end of this process without cleanup.
    let _ = SigSet::from(Signal::SIGXFSZ).thread_block();
    let mut arguments: Vec<_> = std::iter::once("endless".into()).chain(arguments).collect();
    let parse = |arguments: &[OsString]| {
        if arguments.get(1).is_some_and(|name| name == "watch") {
            return Err("there is no command `watch`; `endless status NAME --watch` follows an engine".into());
        }
        let is_learning = arguments.get(1).is_some_and(|name| name == "learn");
        let (mut command, mut arguments) = (command(registry), arguments.to_vec());
        if is_learning {
            arguments = settings::with_negations(&arguments);
            let learn = command.find_subcommand_mut("learn");
            if let Some(learn) = learn {
                *learn = settings::with_defaults(std::mem::take(learn), &arguments)?;
            }
        }
        let arguments = options::plain_numbers(&command, arguments);
        Cli::from_arg_matches(&command.try_get_matches_from(arguments)?).map_err(Failure::from)
    };
    let cli = parse(&arguments).and_then(|cli| match cli.command {
        Some(_) => Ok(cli),
        None => {
            output::print("this is `endless demo`; `endless --help` lists all commands\n")?;
            arguments.push("demo".into());
            parse(&arguments)
        }
    });
    match cli.and_then(|cli| run(registry, cli)) {
        Ok(true) => 0,
        Ok(false) => FAILURE,
        Err(error) => report(&*error),
    }
}

/// The command line, in which the first environment of the registry is the default.
fn command(registry: &Registry) -> clap::Command {
    let Some(id) = registry.specs().next().map(|spec| spec.id) else { return Cli::command() };
    let names = [("demo", "id"), ("serve", "id"), ("play", "id"), ("bench", "id"), ("learn", "env")];
    names.into_iter().fold(Cli::command(), |command, (name, argument)| {
        command.mut_subcommand(name, |command| {
            command.mut_arg(argument, |argument| argument.required(false).default_value(id))
        })
    })
}

/// Prints an error, a usage or a help, and returns the exit status.
fn report(error: &(dyn std::error::Error + 'static)) -> u8 {
    match error.downcast_ref::<clap::Error>() {
        Some(usage) if usage.use_stderr() => {
            // Without standard error, the exit status is the only remaining way to report.
            let _ = usage.print();
            u8::try_from(usage.exit_code()).unwrap_or(FAILURE)
        }
        Some(help) => output::print_help(help).map_or_else(|error| report(&*error), |()| 0),
        None => {
            output::print_error(error);
            FAILURE
        }
    }
}

/// Runs one command. Returns false if `verify` found a difference, or `check` a broken rule.
fn run(registry: &Registry, cli: Cli) -> Result<bool, Failure> {
    logs::start(cli.log.as_deref())?;
    let Some(command) = cli.command else { return Ok(true) };
    match command {
        Command::List(args) => list::run(registry, &args)?,
        Command::Demo(args) => demo::run(registry, &args)?,
        Command::Serve(args) => serve::run(registry, &args)?,
        Command::Status(args) => status::run(&args)?,
        Command::View(args) => view::run(&args)?,
        Command::Play(args) => play::run(registry, &args)?,
        Command::Record(args) => record::run(registry, &args)?,
        Command::Bench(args) if args.compares_threads() => scaling::run(registry, &args)?,
        Command::Bench(args) => bench::run(registry, &args)?,
        Command::Learn(settings) => learn::run(registry, &settings)?,
        Command::New(args) => new::run(registry, &args)?,
        Command::Page(args) => page::run(registry, &args)?,
        Command::Clean => return Ok(endless_gym_service::running_engines(&Namespace::default()).is_err()),
        Command::Verify(args) => return verify::run(registry, &args),
        Command::Check(args) => return check::run(registry, &args),
    }
    Ok(true)
}
