//! `endless learn`.

use std::time::Duration;

use endless_gym_core::pool::Registry;
use endless_gym_service::{ConnectConfig, EngineConfig, Trainer};
use endless_gym_trainer::environments::{Environments, pool_config};
use endless_gym_trainer::settings::{Place, Settings};

use crate::engine_process::EngineProcess;
use crate::failure::Failure;
use crate::stop;

/// Longest wait for the engine of `--connect` to start.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// Runs `endless learn`, until the run is done or a signal stops it.
pub fn run(registry: &Registry, settings: &Settings) -> Result<(), Failure> {
    stop::keep_ignored_hangup();
    let stop = stop::on_signal()?;
    let mut settings = settings.clone();
    // Ends after the trainer.
    let mut engine = None;
    let trainer = if !settings.connect.is_empty() {
        let config = ConnectConfig::new(&settings.connect).timeout(CONNECT_TIMEOUT);
        let trainer = Trainer::connect(&config)?;
        settings = settings.of_engine(trainer.specification())?;
        Some(trainer)
    } else if let Err(unknown) = registry.spec(&settings.env) {
        return Err(format!("{unknown}; for one that another program serves, add --connect SERVICE").into());
    } else if settings.environment.engine == Place::Process {
        let (pool, wanted) = (pool_config(registry, &settings)?, &settings.environment);
        let config = EngineConfig::new("endless", pool, wanted.num_threads).groups(wanted.groups);
        Some(engine.insert(EngineProcess::start(config)?).connect(stop)?)
    } else {
        None
    };
    let environments = |settings: &Settings| match trainer {
        Some(trainer) => Environments::served(settings, trainer),
        None => Environments::in_process(registry, settings),
    };
    endless_gym_trainer::learn(&settings, environments, stop)?;
    Ok(())
}
