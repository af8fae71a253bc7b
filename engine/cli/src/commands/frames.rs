//! `endless frames`: the raw frames of an expert's episode, for programs that turn them into pictures.

use endless_gym_core::pool::Registry;
use std::io::{self, ErrorKind, Write};

use crate::failure::Failure;
use crate::film::Film;
use crate::options::EnvironmentArgs;

/// Arguments of `endless frames`.
#[derive(clap::Args)]
pub struct Args {
    /// Environment id; `endless list` lists them.
    #[arg(long = "env", value_name = "ID")]
    id: String,
    /// Number of steps after which the film ends, if the episode has not ended.
    #[arg(long, default_value_t = 1000)]
    steps: usize,
    #[command(flatten)]
    environment: EnvironmentArgs,
}

/// Runs `endless frames`: for the start and each step of the first episode, writes the observation and the ground-truth view,
/// such as uint8 (84, 84, 3) and (336, 336, 3), both indexed \[row\]\[column\]\[channel\].
pub fn run(registry: &Registry, args: &Args) -> Result<(), Failure> {
    let mut film = Film::new(registry, &args.environment.configure(&args.id, 1)?)?;
    let mut stdout = io::stdout().lock();
    for _ in 0..=args.steps {
        let view = film.ground_truth_view()?;
        match stdout.write_all(&film.observation()?.pixels).and_then(|()| stdout.write_all(&view.pixels)) {
            Err(error) if error.kind() == ErrorKind::BrokenPipe => break,
            written => written.map_err(|error| format!("cannot write to standard output: {error}"))?,
        }
        if !film.step()? {
            break;
        }
    }
    Ok(())
}
