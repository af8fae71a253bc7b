//! `endless play`: an environment for a person, on a page or in the terminal.

use endless_gym_core::pool::{PoolConfig, Registry, ResetOptions};
use endless_gym_page::PlayServer;

use crate::commands::view::PageArgs;
use crate::failure::Failure;
use crate::open;
use crate::options::parameters;
use crate::output::print;
use crate::stop;
use crate::terminal;

/// Arguments of `endless play`.
///
/// In the terminal, arrows or W A S D move, Q E Z C move diagonally, where choices are named left, right, up, ahead or
/// down. Digits choose other choices by their number, which arrows also change, as they do the numbers of a box; Tab
/// selects the next number, and Enter plays where the game waits for an action. The episode starts with the first key.
/// Space or P pauses; while paused, N plays one step without moving, and a movement key plays one step with it. R
/// restarts the episode, page up and page down start the episode of the next and the previous seed, Esc or Ctrl-C quits.
///
/// Most terminals do not report when a key is released, but report a key that is down repeatedly, after a delay that
/// the system sets. A key acts in at least one step, until HOLD seconds after its last report. Another direction
/// replaces it at once; two keys pressed within one step move diagonally. In terminals with the kitty keyboard
/// protocol, which reports releases, a key acts while it is down.
#[derive(clap::Args)]
pub struct Args {
    /// Environment id; `endless list` lists them.
    #[arg(value_name = "ID")]
    id: String,
    /// Seed of the first episode [default: random, 0 to 99,999, on the page; 0 in the terminal].
    #[arg(long)]
    seed: Option<u64>,
    /// Reset parameter, such as `arena_size=6`; may be repeated [default: the environment's own, which `endless list ID` shows].
    #[arg(long = "option", value_name = "NAME=VALUE")]
    options: Vec<String>,
    #[command(flatten)]
    page: PageArgs,
    #[command(flatten)]
    terminal: terminal::play::TerminalArgs,
}

/// Runs `endless play`, until a signal stops it.
pub fn run(registry: &Registry, args: &Args) -> Result<(), Failure> {
    let options = parameters(&args.options)?;
    if args.terminal.terminal {
        return terminal::play::run(registry, &args.id, options, args.seed.unwrap_or(0), &args.terminal);
    }
    let spec = registry.spec(&args.id)?;
    PoolConfig::new(spec.id, 1).options(ResetOptions::Shared(options.clone())).validate(spec)?;
    let stop = stop::on_signal()?;
    let server = PlayServer::bind(args.page.port, spec.id)?;
    let url = server.url(spec.id, &options, args.seed);
    print(format_args!("play {} at {url}\nstop with Ctrl-C", spec.id))?;
    if args.page.open {
        open::in_browser(&url);
    }
    Ok(server.run(stop)?)
}
