//! `endless demo`: the main job, from an engine's shared memory to a trainer.

use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use clap::Parser;
use endless_gym_core::envs::{self, EnvSpec, Family};
use endless_gym_core::pool::ResetRequest;
use endless_gym_service::timeout_from_seconds;
use serde_json::{Map, Value as Json, json};

use super::engine_process::EngineProcess;
use super::options::EnvironmentArgs;
use super::output::{grouped, print, print_json, progress, table};
use super::play::{ExpertPlayer, Policy, RandomPlayer, Tally};
use super::{Failure, stop};

#[derive(clap::Args)]
pub struct Args {
    /// Environment id; `endless list` shows them.
    #[arg(long = "env", value_name = "ID", default_value = "MortarMayhem-v0")]
    id: String,
    /// Who plays.
    #[arg(long, value_enum, default_value = "expert")]
    policy: Policy,
    /// Environments in each group [default: 512, or 16 for the expert of Searing Spotlights, which thinks long].
    #[arg(long)]
    num_envs: Option<usize>,
    /// Groups: the engine steps one while the trainer works on the other.
    #[arg(long, default_value_t = 2)]
    groups: usize,
    /// Threads of the engine; 0 for one for each core.
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// How long to play.
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    #[command(flatten)]
    environment: EnvironmentArgs,
    /// Print the summary as JSON.
    #[arg(long)]
    json: bool,
}

/// The demo as it is without options.
#[derive(Parser)]
struct Defaults {
    #[command(flatten)]
    args: Args,
}

impl Default for Args {
    fn default() -> Self {
        Defaults::parse_from([""]).args
    }
}

/// How often the live figures change.
const REFRESH: Duration = Duration::from_millis(250);

/// Longest time that an engine may take for one step.
const PATIENCE: Duration = Duration::from_secs(60);

pub fn run(args: &Args) -> Result<ExitCode, Failure> {
    let spec = envs::spec(&args.id)?;
    let seconds = timeout_from_seconds(args.seconds)
        .map_err(|_| format!("--seconds must be finite and not negative, got {}", args.seconds))?;
    let stop = stop::on_signal()?;
    let num_envs = args.num_envs.unwrap_or(match (spec.family, args.policy) {
        (Family::SearingSpotlights(_), Policy::Expert) => 16,
        _ => 512,
    });
    let mut arguments: Vec<String> = [
        ("--env", args.id.clone()),
        ("--num-envs", num_envs.to_string()),
        ("--groups", args.groups.to_string()),
        ("--threads", args.threads.to_string()),
    ]
    .into_iter()
    .flat_map(|(name, value)| [name.to_owned(), value])
    .collect();
    arguments.push("--features".to_owned());
    arguments.extend(args.environment.arguments());
    let mut engine = EngineProcess::start(&arguments)?;
    let mut trainer = engine.connect()?;

    let mut random = RandomPlayer::new(spec);
    let mut experts: Vec<_> = (0..args.groups).map(|_| ExpertPlayer::new(spec, num_envs)).collect();
    let mut tally = Tally::new(spec);
    for group in 0..args.groups {
        trainer.reset(group, ResetRequest::All)?;
    }
    let bar = progress(args.seconds.ceil() as u64, "{spinner} {pos}/{len} s  {msg}");
    let start = Instant::now();
    let mut refreshed = start;
    while start.elapsed() < seconds && !stop.load(Ordering::Relaxed) {
        for (group, experts) in experts.iter_mut().enumerate() {
            let received = trainer.receive(group, PATIENCE)?;
            let batch = received.batch();
            tally.add(&batch);
            trainer.send_with(group, |actions| match args.policy {
                Policy::Expert => experts.act(&batch, actions),
                Policy::Random => random.act(actions),
            })?;
        }
        if refreshed.elapsed() >= REFRESH {
            refreshed = Instant::now();
            bar.set_position(start.elapsed().as_secs());
            bar.set_message(live(spec, &tally, start.elapsed()));
        }
    }
    bar.finish_and_clear();
    summarise(args, spec, num_envs, &tally, start.elapsed())?;
    Ok(ExitCode::SUCCESS)
}

fn per_second(tally: &Tally, elapsed: Duration) -> f64 {
    tally.steps as f64 / elapsed.as_secs_f64()
}

fn live(spec: &EnvSpec, tally: &Tally, elapsed: Duration) -> String {
    let mut text = format!(
        "{} steps/s, {} episodes, {}",
        grouped(per_second(tally, elapsed)),
        grouped(tally.episodes as f64),
        if tally.episodes > 0 {
            format!("mean return {:.3}", tally.mean_return())
        } else {
            format!("mean return so far {:.3}", tally.running_return)
        }
    );
    if tally.episodes == 0 {
        return text;
    }
    for (column, mean) in spec.info.iter().zip(tally.mean_info()) {
        text += &format!(", {} {mean:.3}", column.name.replace('_', " "));
    }
    text
}

fn summarise(args: &Args, spec: &EnvSpec, num_envs: usize, tally: &Tally, elapsed: Duration) -> Result<(), Failure> {
    let policy = match args.policy {
        Policy::Expert => "expert",
        Policy::Random => "random",
    };
    if args.json {
        let info: Map<String, Json> = spec
            .info
            .iter()
            .zip(tally.mean_info())
            .map(|(column, mean)| (column.name.to_owned(), json!(mean)))
            .collect();
        return print_json(&json!({
            "environment": spec.id,
            "policy": policy,
            "num_envs": num_envs,
            "groups": args.groups,
            "seconds": elapsed.as_secs_f64(),
            "steps": tally.steps,
            "steps_per_second": per_second(tally, elapsed),
            "episodes": tally.episodes,
            "mean_return": tally.mean_return(),
            "mean_length": tally.mean_length(),
            "mean_running_return": tally.running_return,
            "mean_info": info,
        }));
    }
    let mut rows = table([spec.id, ""]);
    let environments = format!("{} in {} groups, another process", num_envs * args.groups, args.groups);
    rows.add_row(["environments", &environments]);
    rows.add_row(["policy", policy]);
    rows.add_row(["seconds", &format!("{:.1}", elapsed.as_secs_f64())]);
    rows.add_row(["steps", &grouped(tally.steps as f64)]);
    rows.add_row(["steps per second", &grouped(per_second(tally, elapsed))]);
    rows.add_row(["episodes", &grouped(tally.episodes as f64)]);
    if tally.episodes > 0 {
        rows.add_row(["mean return", &format!("{:.3}", tally.mean_return())]);
        rows.add_row(["mean length", &format!("{:.1}", tally.mean_length())]);
        for (column, mean) in spec.info.iter().zip(tally.mean_info()) {
            rows.add_row([&format!("mean {}", column.name.replace('_', " ")), &format!("{mean:.3}")]);
        }
    } else {
        rows.add_row(["mean return so far", &format!("{:.3}", tally.running_return)]);
    }
    print(rows);
    Ok(())
}
