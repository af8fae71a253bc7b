//! `endless record`: films. The Python package's program records data sets itself, with Python libraries.

use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

use clap::{CommandFactory, Parser};
use endless_gym_core::pool::{PoolConfig, PoolError, Registry, ResetOptions, Seeding};

use crate::failure::Failure;
use crate::film::Film;
use crate::film::file::{FilmFile, Shape};
use crate::film::picture::View;
use crate::options::{parameters, plain_numbers};
use crate::output::print;
use crate::policies::Policy;
use crate::stop;

/// Arguments of `endless record`: those of a film, or those of a data set, which the Python package parses.
#[derive(clap::Args)]
pub struct Args {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    arguments: Vec<OsString>,
}

/// Record a film of scripted experts or random actions.
///
/// Each episode is played in a new environment, so that it depends only on its seed and reset parameters. Without
/// --film, the Python package's program `endless record` writes a Minari data set.
#[derive(Parser)]
#[command(name = "endless record", max_term_width = 110)]
struct FilmArgs {
    /// Environment id; `endless list` lists them.
    #[arg(value_name = "ID")]
    id: String,
    /// File of the film: .webp (lossless) or .mp4 (needs ffmpeg).
    #[arg(long, value_name = "FILE")]
    film: PathBuf,
    /// Number of episodes, shown in order.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Number of steps after which an episode is cut off.
    #[arg(long, value_name = "N", default_value_t = 1000)]
    max_steps: u32,
    /// Policy that chooses the actions.
    #[arg(long, value_enum, default_value = "expert")]
    policy: Policy,
    /// Seed: episode i has the seed SEED + i.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Seed of the random actions.
    #[arg(long, value_name = "SEED", default_value_t = 0)]
    action_seed: u64,
    /// Reset parameter, such as `arena_size=6`; may be repeated [default: the environment's own, which `endless list ID` shows].
    #[arg(long = "option", value_name = "NAME=VALUE")]
    options: Vec<String>,
    /// What the film shows.
    #[arg(long, value_enum, default_value = "both")]
    view: View,
    /// Pictures per second, 1 to 100 [default: the environment's].
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..=100))]
    fps: Option<u16>,
    /// Pixels of the film for each pixel of a frame in each direction, 1 to 16.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=16))]
    scale: u8,
}

/// Runs `endless record`.
pub fn run(registry: &Registry, args: &Args) -> Result<(), Failure> {
    let is = |argument: &OsString, name: &str| {
        argument.to_str().is_some_and(|given| {
            given.strip_prefix(name).is_some_and(|rest| matches!(rest.as_bytes(), [] | [b'=', ..]))
        })
    };
    let is_film =
        args.arguments.iter().any(|argument| ["--film", "--help", "-h"].iter().any(|name| is(argument, name)));
    if !is_film {
        return Err("a data set is recorded by the Python package's program `endless`, with `record` as its first argument: \
             pip install './bindings/python[minari]', or the wheel file with `[minari]` appended; a film needs `--film FILE`"
            .into());
    }
    let arguments = std::iter::once("endless record".into()).chain(args.arguments.iter().cloned());
    film(registry, &FilmArgs::try_parse_from(plain_numbers(&FilmArgs::command(), arguments.collect()))?)
}

impl FilmArgs {
    /// The start of an episode.
    fn start(&self, registry: &Registry, episode: u64) -> Result<Film, Failure> {
        let config = PoolConfig::new(&self.id, 1)
            .options(ResetOptions::Shared(parameters(&self.options)?))
            .seeding(Seeding::Continue { seed: Some(self.seed.wrapping_add(episode)) });
        Film::new(registry, &config, self.policy, self.action_seed.wrapping_add(episode))
    }
}

/// Records the film, and prints the return and the length of each episode.
fn film(registry: &Registry, args: &FilmArgs) -> Result<(), Failure> {
    let spec = registry.spec(&args.id)?;
    let fps = args.fps.unwrap_or(u16::try_from(spec.render_fps)?);
    let size = args.view.size(spec.shown().ok_or(PoolError::NoFrame { id: spec.id })?);
    let shape = Shape { size, scale: usize::from(args.scale), fps };
    let stop = stop::on_signal()?;
    // Create the environment first, so that invalid options are reported before a file exists.
    let mut next = Some(args.start(registry, 0)?);
    let mut file = FilmFile::create(&args.film, shape)?;
    let mut played = Vec::new();
    for episode in 0..args.episodes {
        let mut film = next.take().map_or_else(|| args.start(registry, episode), Ok)?;
        for step in 0..=args.max_steps {
            if stop.load(Ordering::Relaxed) {
                return Err("stopped, and wrote nothing".into());
            }
            let picture = args.view.picture(&mut film)?;
            let is_last = step == args.max_steps || !film.step()?;
            // Show an episode's last picture for one second longer.
            file.add(&picture, if is_last { 1 + fps } else { 1 })?;
            if is_last {
                break;
            }
        }
        let (total, length) = film.episode();
        played.push(format!("seed {}: return {total:.3} in {length} steps", args.seed.wrapping_add(episode)));
    }
    file.finish()?;
    played.into_iter().try_for_each(print)?;
    print(args.film.display())
}
