//! `endless learn`.

use endless_gym_core::pool::Registry;
use endless_gym_service::EngineConfig;
use endless_gym_trainer::environments::{Environments, pool_config};
use endless_gym_trainer::settings::{Place, Settings};

use super::engine_process::EngineProcess;
use super::failure::Failure;
use super::stop;

/// Runs `endless learn`, until the run is done or a signal stops it.
pub fn run(registry: &Registry, settings: &Settings) -> Result<(), Failure> {
    stop::keep_ignored_hangup();
    let stop = stop::on_signal()?;
    // Ends after the trainer.
    let mut engine = None;
    if settings.environment.engine == Place::Process {
        let (pool, wanted) = (pool_config(registry, settings)?, &settings.environment);
        let config = EngineConfig::new("endless", pool, wanted.num_threads);
        engine = Some(EngineProcess::start(EngineConfig { groups: wanted.groups, ..config })?);
    }
    let trainer = engine.as_mut().map(|engine| engine.connect(stop)).transpose()?;
    let environments = |settings: &Settings| match trainer {
        Some(trainer) => Environments::served(registry, settings, trainer),
        None => Environments::in_process(registry, settings),
    };
    endless_gym_trainer::learn(settings, environments, stop)?;
    Ok(())
}
