//! `endless demo`: an engine in a child process, and a trainer that plays through shared memory.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use endless_gym_core::envs::EnvSpec;
use endless_gym_core::pool::{Autoreset, Experts, Registry, ResetRequest};
use endless_gym_service::EngineConfig;
use serde_json::{Map, Value as Json, json};

use crate::commands::view::Beside;
use crate::engine_process::EngineProcess;
use crate::failure::Failure;
use crate::options::{self, EnvironmentArgs};
use crate::output::{grouped, print, print_json, progress, table};
use crate::policies::{EpisodeStatistics, Policy, RandomPolicy};
use crate::stop;

/// Arguments of `endless demo`.
#[derive(clap::Args)]
pub struct Args {
    /// Environment id; `endless list` lists them.
    #[arg(long = "env", value_name = "ID")]
    id: String,
    /// Policy that chooses the actions.
    #[arg(long, value_enum, default_value = "expert")]
    policy: Policy,
    /// Environments in each group [default: 512; 64 with experts].
    #[arg(long)]
    num_envs: Option<usize>,
    /// Groups of environments; the engine steps one group while the policy acts in another.
    #[arg(long, default_value_t = 2)]
    groups: usize,
    /// Threads of the engine; 0 for one per core.
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Duration in seconds [default: 10; with `--view` until Ctrl-C].
    #[arg(long)]
    seconds: Option<f64>,
    /// Show the environments in a browser, as `endless view` does: print the address [default: no page].
    #[arg(long, conflicts_with = "json")]
    view: bool,
    /// Open that page in the browser that the variable BROWSER names, or the desktop [default: print the address].
    #[arg(long, requires = "view")]
    open: bool,
    #[command(flatten)]
    environment: EnvironmentArgs,
    /// Print JSON [default: text].
    #[arg(long)]
    json: bool,
}

/// Duration without `--seconds`.
const SECONDS: f64 = 10.0;

/// Time between two updates of the progress bar.
const REFRESH_INTERVAL: Duration = Duration::from_millis(250);

/// Longest time that an engine may take for one step.
const STEP_TIMEOUT: Duration = Duration::from_secs(60);

/// Runs `endless demo`.
pub fn run(registry: &Registry, args: &Args) -> Result<(), Failure> {
    let spec = registry.spec(&args.id)?;
    let seconds = match (args.seconds, args.view) {
        (None, true) => Duration::MAX,
        (given, _) => options::seconds("--seconds", given.unwrap_or(SECONDS))?,
    };
    let stop = stop::on_signal()?;
    let num_envs = args.num_envs.unwrap_or(match args.policy {
        Policy::Expert => 64,
        Policy::Random => 512,
    });
    let pool = args.environment.configure(&args.id, num_envs)?.features(true);
    let config = EngineConfig::new("endless", pool, args.threads).groups(args.groups);
    let mut engine = EngineProcess::start(config)?;
    let mut trainer = engine.connect(stop)?;
    let _view = if args.view { Some(Beside::start(engine.service(), args.open)?) } else { None };

    let mut random = RandomPolicy::new(spec, 0);
    let experts = || Experts::new(registry, spec.id, num_envs, Autoreset::NextStep);
    let mut experts: Vec<_> = match args.policy {
        Policy::Expert => (0..args.groups).map(|_| experts()).collect::<Result<_, _>>()?,
        Policy::Random => Vec::new(),
    };
    let mut statistics = EpisodeStatistics::new(spec);
    for group in 0..args.groups {
        trainer.reset(group, ResetRequest::All)?;
    }
    let template = if seconds == Duration::MAX { "{spinner} {pos} s  {msg}" } else { "{spinner} {pos}/{len} s  {msg}" };
    let bar = progress(seconds.as_secs_f64().ceil() as u64, template);
    let start = Instant::now();
    let mut refreshed = start;
    while start.elapsed() < seconds && !stop.load(Ordering::Relaxed) {
        for (group, experts) in experts.iter_mut().enumerate() {
            let received = trainer.receive(group, STEP_TIMEOUT)?;
            let batch = received.batch();
            statistics.add(&batch);
            let mut acted = Ok(());
            trainer.send_with(group, |actions| match args.policy {
                Policy::Expert => acted = experts.act(&batch, actions),
                Policy::Random => random.act(actions),
            })?;
            acted?;
        }
        if refreshed.elapsed() >= REFRESH_INTERVAL {
            refreshed = Instant::now();
            bar.set_position(start.elapsed().as_secs());
            bar.set_message(live(spec, &statistics, start.elapsed()));
        }
    }
    bar.finish_and_clear();
    summarise(args, spec, num_envs, &statistics, start.elapsed())
}

fn per_second(statistics: &EpisodeStatistics, elapsed: Duration) -> f64 {
    statistics.steps as f64 / elapsed.as_secs_f64()
}

/// The text of the progress bar.
fn live(spec: &EnvSpec, statistics: &EpisodeStatistics, elapsed: Duration) -> String {
    let mut text = format!(
        "{} steps/s, {} episodes, {}",
        grouped(per_second(statistics, elapsed)),
        grouped(statistics.episodes as f64),
        if statistics.episodes > 0 {
            format!("mean return {:.3}", statistics.mean_return())
        } else {
            format!("mean return so far {:.3}", statistics.running_return)
        }
    );
    if statistics.episodes == 0 {
        return text;
    }
    for (column, mean) in spec.info.iter().zip(statistics.mean_info()) {
        text += &format!(", {} {mean:.3}", column.name.replace('_', " "));
    }
    text
}

fn summarise(
    args: &Args,
    spec: &EnvSpec,
    num_envs: usize,
    statistics: &EpisodeStatistics,
    elapsed: Duration,
) -> Result<(), Failure> {
    let policy = if args.policy == Policy::Expert { "expert" } else { "random" };
    if args.json {
        let info: Map<String, Json> = spec
            .info
            .iter()
            .zip(statistics.mean_info())
            .map(|(column, mean)| (column.name.to_owned(), json!(mean)))
            .collect();
        return print_json(&json!({
            "environment": spec.id,
            "policy": policy,
            "num_envs": num_envs,
            "groups": args.groups,
            "seconds": elapsed.as_secs_f64(),
            "steps": statistics.steps,
            "steps_per_second": per_second(statistics, elapsed),
            "episodes": statistics.episodes,
            "mean_return": statistics.mean_return(),
            "mean_length": statistics.mean_length(),
            "mean_running_return": statistics.running_return,
            "mean_info": info,
        }));
    }
    let mut rows = table([spec.id, ""]);
    let environments = format!("{} in {} groups, in a child process", num_envs * args.groups, args.groups);
    rows.add_row(["environments", &environments]);
    rows.add_row(["policy", policy]);
    rows.add_row(["seconds", &format!("{:.1}", elapsed.as_secs_f64())]);
    rows.add_row(["steps", &grouped(statistics.steps as f64)]);
    rows.add_row(["steps per second", &grouped(per_second(statistics, elapsed))]);
    rows.add_row(["episodes", &grouped(statistics.episodes as f64)]);
    if statistics.episodes > 0 {
        rows.add_row(["mean return", &format!("{:.3}", statistics.mean_return())]);
        rows.add_row(["mean length", &format!("{:.1}", statistics.mean_length())]);
        for (column, mean) in spec.info.iter().zip(statistics.mean_info()) {
            rows.add_row([&format!("mean {}", column.name.replace('_', " ")), &format!("{mean:.3}")]);
        }
    } else {
        rows.add_row(["mean return so far", &format!("{:.3}", statistics.running_return)]);
    }
    print(rows)
}
