//! `endless play`: the page on which the environments are played, served on this machine.

use endless_gym_core::envs;
use endless_gym_core::pool::{PoolConfig, ResetOptions};
use endless_gym_view::PlayServer;
use serde_json::{Map, Value as Json};

use super::failure::Failure;
use super::open;
use super::output::print;
use super::stop;

/// Arguments of `endless play`.
#[derive(clap::Args)]
pub struct Args {
    /// Environment id; `endless list` lists them.
    #[arg(default_value = "MortarMayhem-v0")]
    id: String,
    /// Reset parameters as a JSON object, such as '{"arena_size": 6}' [default: the environment's own, which
    /// `endless list ID` shows].
    #[arg(long, value_name = "JSON")]
    env_options: Option<String>,
    /// Seed of the episode [default: random, 0 to 99,999].
    #[arg(long)]
    seed: Option<u64>,
    /// Port on 127.0.0.1; 0 takes any that is free.
    #[arg(long, default_value_t = 0)]
    port: u16,
    /// Open the page in a browser, with `xdg-open` [default: print the address].
    #[arg(long)]
    open: bool,
}

/// Runs `endless play`, until a signal stops it.
pub fn run(args: &Args) -> Result<(), Failure> {
    let spec = envs::spec(&args.id)?;
    let options: Map<String, Json> = match &args.env_options {
        Some(text) => serde_json::from_str(text).map_err(|error| format!("--env-options {text}: {error}"))?,
        None => Map::new(),
    };
    PoolConfig { options: ResetOptions::Shared(options.clone()), ..PoolConfig::new(spec.id, 1) }.validate()?;
    let stop = stop::on_signal()?;
    let server = PlayServer::bind(args.port)?;
    let url = server.url(spec.id, &options, args.seed);
    print(format_args!("play {} at {url}\nstop with Ctrl-C", spec.id))?;
    if args.open {
        open::in_browser(&url)?;
    }
    Ok(server.run(stop)?)
}
