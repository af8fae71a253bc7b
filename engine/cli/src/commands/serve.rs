//! `endless serve`.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::thread;
use std::time::Duration;

use endless_gym_core::files;
use endless_gym_core::pool::{Autoreset, Registry};
use endless_gym_service::{CheckpointConfig, Engine, EngineActivity, EngineConfig, EngineMonitor, ServiceError};
use endless_gym_view::MetricsServer;
use serde::Deserialize;

use crate::engine_process::replace_by_cleanup;
use crate::failure::Failure;
use crate::options::{EnvironmentArgs, FrameArgs, autoreset_parser, autoreset_value};
use crate::output::{grouped, print, print_error};
use crate::stop::{self, Watchdog};

/// How often the command checks whether the engine has ended.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// Arguments of `endless serve`.
#[derive(clap::Args)]
pub struct Args {
    /// Read the engine's configuration as JSON from FILE, or from standard input for `-` [default: the options below].
    #[arg(long, value_name = "FILE", conflicts_with_all = ["EngineArgs", "EnvironmentArgs", "FrameArgs"])]
    config: Option<PathBuf>,
    #[command(flatten)]
    engine: EngineArgs,
    #[command(flatten)]
    environment: EnvironmentArgs,
    #[command(flatten)]
    frames: FrameArgs,
    /// Serve metrics for Prometheus at http://ADDRESS/metrics, such as 127.0.0.1:9100; port 0 takes any free port.
    #[arg(long, value_name = "ADDRESS")]
    metrics: Option<SocketAddr>,
    /// For an engine that is a child process: print nothing, and stop when standard input closes or delivers a byte.
    /// With the id of the parent process, also stop when that process ends.
    #[arg(long, value_name = "PARENT", num_args = 0..=1, require_equals = true, hide = true)]
    #[expect(clippy::option_option, reason = "clap's form of an option with an optional value")]
    child: Option<Option<u32>>,
}

/// The engine's configuration, except environments and frames: clap makes a group of the arguments of a struct without flattened
/// fields.
#[derive(clap::Args)]
struct EngineArgs {
    /// Environment id; `endless list` lists them.
    #[arg(long = "env", value_name = "ID")]
    id: String,
    /// Environments in each group.
    #[arg(long, default_value_t = 1024)]
    num_envs: usize,
    /// Threads that step environments; 0 for one per core.
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Bind each of these threads to a CPU of its own, in the order of the process's affinity mask. Leave one CPU to the trainer.
    #[arg(long)]
    pin_threads: bool,
    /// Groups of environments. They are stepped independently, so that the trainer can process one while the engine
    /// steps another.
    #[arg(long, default_value_t = EngineConfig::GROUPS)]
    groups: usize,
    /// Name of the engine, by which trainers find it: 1 to 64 letters, digits, `.`, `_` or `-`.
    #[arg(long, value_name = "NAME", default_value = "endless", alias = "name")]
    service: String,
    /// When the next episode starts after one has ended, as in Gymnasium.
    #[arg(long, value_name = "MODE", value_parser = autoreset_parser(), default_value = autoreset_value(Autoreset::default()))]
    autoreset: Autoreset,
    /// With `--autoreset same-step`, also write the last observation of each episode that ends.
    #[arg(long)]
    final_observation: bool,
    /// Also write the feature observation, a float32 vector that describes what the frame shows.
    #[arg(long)]
    features: bool,
    /// Also write the hidden Markov state, of environments that tell it: those of POPGym.
    #[arg(long)]
    state: bool,
    /// Batches of each group that the trainer may hold at a time, 1 to 16.
    #[arg(long, default_value_t = EngineConfig::BATCHES_HELD)]
    batches_held: usize,
    /// Save all environments to FILE when the engine stops and when its trainer requests it.
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Also save while the engine runs, at this interval, such as `30s`, `5m` or `1h 30m`.
    #[arg(long, value_name = "DURATION", requires = "checkpoint", value_parser = humantime::parse_duration)]
    every: Option<Duration>,
    /// Resume from FILE if it exists; the episodes continue identically. Without this, an existing FILE is an error.
    #[arg(long, requires = "checkpoint")]
    resume: bool,
}

impl EngineArgs {
    fn configure(&self, environment: &EnvironmentArgs, frames: FrameArgs) -> Result<EngineConfig, Failure> {
        let pool = environment
            .configure(&self.id, self.num_envs)?
            .autoreset(self.autoreset)
            .final_observation(self.final_observation)
            .frames(frames.frames())
            .features(self.features)
            .state(self.state);
        let checkpoint =
            self.checkpoint.clone().map(|path| CheckpointConfig::new(path).every(self.every).resume(self.resume));
        let (groups, batches_held) = (self.groups, self.batches_held);
        Ok(EngineConfig::new(&self.service, pool, self.threads)
            .pin_threads(self.pin_threads)
            .checkpoint(checkpoint)
            .groups(groups)
            .batches_held(batches_held))
    }
}

/// Reads a configuration from a file, or from standard input for `-`. There, it ends with its last bracket; the rest is
/// for `--child`.
fn read(path: &Path) -> Result<EngineConfig, Failure> {
    let config = if path == Path::new("-") {
        EngineConfig::deserialize(&mut serde_json::Deserializer::from_reader(std::io::stdin()))
    } else {
        let text = files::read(path).map_err(|e| format!("--config {}: {e}", path.display()))?;
        serde_json::from_slice(&text)
    };
    Ok(config.map_err(|e| format!("--config {}: {e}", path.display()))?)
}

/// Ends this process if the engine was asked to stop while a step, or another call of an environment, does not end. Saving a
/// checkpoint takes as long as it takes.
fn watch(engine: &Engine, config: &EngineConfig, stop: &'static AtomicBool) -> Result<Option<Watchdog>, Failure> {
    let Some(monitor) = EngineMonitor::open(&config.namespace, engine.specification()) else { return Ok(None) };
    let (service, id, namespace) = (config.service.clone(), config.pool.id.clone(), config.namespace.clone());
    let stuck = move |grace| match monitor.longest()? {
        activity @ EngineActivity::Busy { since, .. } if since >= grace => {
            Some(format!("engine `{service}` of {id} was asked to stop, but {activity}; it ends without saving"))
        }
        _ => None,
    };
    let end = move |text| {
        print_error(text);
        replace_by_cleanup(&namespace);
    };
    stop::watch(stop, stuck, end).map(Some)
}

/// Runs `endless serve`, until a signal stops it.
pub fn run(registry: &Registry, args: &Args) -> Result<(), Failure> {
    // Before `on_signal`, so that a signal still ends a process that waits for standard input.
    let configured = || args.engine.configure(&args.environment, args.frames);
    let mut config = args.config.as_deref().map_or_else(configured, read)?;
    let stop = stop::on_signal()?;
    if let Some(parent) = args.child {
        stop::with_parent(stop, parent)?;
    }
    let bind = |address| MetricsServer::bind(address).map_err(|error| format!("--metrics {address}: {error}"));
    let metrics = args.metrics.map(bind).transpose()?;
    let mut engine = Engine::new(registry, &config)?;
    if args.child.is_none() {
        let (groups, num_envs) = (config.groups, config.pool.num_envs);
        let groups = if groups == 1 { "1 group".to_owned() } else { format!("{groups} groups") };
        print(format_args!(
            "serving {} as `{}`: {groups} of {num_envs} environments; stop with Ctrl-C",
            config.pool.id, config.service
        ))?;
        if let Some(CheckpointConfig { path, resume: true, .. }) = &config.checkpoint {
            let steps: Vec<_> = engine.steps().iter().map(u64::to_string).collect();
            let steps = steps.join(", ");
            print(match steps.chars().all(|c| "0, ".contains(c)) {
                true => format!("{} does not exist yet: the environments start with new episodes", path.display()),
                false => format!("resumed from {} after {steps} batches", path.display()),
            })?;
        }
        if let Some(metrics) = &metrics {
            print(format_args!("metrics at {}", metrics.url()))?;
        }
    }
    if let Some(metrics) = metrics {
        let (namespace, service) = (config.namespace.clone(), config.service.clone());
        let serve = move || {
            if let Err(error) = metrics.run(namespace, service) {
                print_error(&error);
            }
        };
        // A thread of its own, so that a slow client delays neither the engine nor the end of the process.
        thread::Builder::new().name("metrics".to_owned()).spawn(serve)?;
    }
    let summary = loop {
        let watchdog = watch(&engine, &config, stop)?;
        let running = engine.spawn()?;
        while !running.is_finished() && !stop::wait(stop, CHECK_INTERVAL) {}
        running.stop();
        let finished = running.join();
        drop(watchdog);
        match finished {
            // The episodes are lost, but a trainer can reconnect without user action.
            Err(error @ ServiceError::RootRemoved { .. }) => {
                print_error(&error);
                if let Some(checkpoint) = &mut config.checkpoint {
                    checkpoint.resume = true;
                }
                engine = Engine::new(registry, &config)?;
            }
            finished => break finished?,
        }
    };
    if args.child.is_none() {
        let (steps, batches) = (grouped(summary.env_steps as f64), grouped(summary.batches as f64));
        print(format_args!("{steps} steps in {batches} batches"))?;
    }
    Ok(())
}
