//! `endless play`: the page on which the environments are played, served on this machine.

use endless_gym_core::envs;
use endless_gym_core::pool::{OptionMap, PoolConfig, ResetOptions};
use endless_gym_view::PlayServer;

use super::failure::Failure;
use super::open;
use super::output::print;
use super::stop;
use super::view::PageArgs;

/// Serves the page, until a signal stops it.
pub fn run(id: &str, options: OptionMap, seed: Option<u64>, page: &PageArgs) -> Result<(), Failure> {
    let spec = envs::spec(id)?;
    PoolConfig { options: ResetOptions::Shared(options.clone()), ..PoolConfig::new(spec.id, 1) }.validate()?;
    let stop = stop::on_signal()?;
    let server = PlayServer::bind(page.port)?;
    let url = server.url(spec.id, &options, seed);
    print(format_args!("play {} at {url}\nstop with Ctrl-C", spec.id))?;
    if page.open {
        open::in_browser(&url);
    }
    Ok(server.run(stop)?)
}
