//! `endless bench`.

use std::process::{Command, ExitCode};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use endless_gym_core::batch::{Batch, zeroed};
use endless_gym_core::envs::{self, DEFAULT_ENV_ID, EnvSpec};
use endless_gym_core::pool::{Pool, ResetRequest, Threads};
use endless_gym_service::timeout_from_seconds;
use serde::Serialize;

use super::engine_process::EngineProcess;
use super::options::EnvironmentArgs;
use super::output::{grouped, print, print_json, progress, table};
use super::play::RandomPlayer;
use super::{Failure, stop};

/// The script that steps the original.
const ORIGINAL: &str = include_str!("original.py");

/// Longest time that an engine may take for one step.
const PATIENCE: Duration = Duration::from_secs(60);

/// Measures steps per second: whole episodes with resets, random actions.
///
/// Each way of stepping is measured in several rounds, one after the other in each round, and the median is shown, since other
/// programs on the machine disturb a measurement.
#[derive(clap::Args)]
pub struct Args {
    /// Environment id, or `all`.
    #[arg(long = "env", value_name = "ID", default_value = DEFAULT_ENV_ID)]
    id: String,
    /// Environments.
    #[arg(long, default_value_t = 1024)]
    num_envs: usize,
    /// Threads of the engine that the service runs; 0 for one for each core.
    #[arg(long, default_value_t = 1)]
    threads: usize,
    /// Seconds of one measurement.
    #[arg(long, default_value_t = 1.0)]
    seconds: f64,
    /// Measurements of each kind.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..))]
    rounds: u16,
    /// Measure the original too, with this Python, which must have `memory-gym` installed.
    #[arg(long, value_name = "PYTHON")]
    original: Option<String>,
    #[command(flatten)]
    environment: EnvironmentArgs,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// A way of stepping.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    InProcess { threads: usize },
    ServiceReceives,
    ServiceReads,
    Original,
}

/// What one environment reached.
#[derive(Serialize)]
struct Row {
    environment: &'static str,
    num_envs: usize,
    service_threads: usize,
    measurements: Vec<Measurement>,
}

#[derive(Serialize)]
struct Measurement {
    way: String,
    /// Median of the rounds.
    steps_per_second: f64,
    lowest: f64,
    highest: f64,
}

pub fn run(args: &Args) -> Result<ExitCode, Failure> {
    timeout_from_seconds(args.seconds)
        .map_err(|_| format!("--seconds must be finite and not negative, got {}", args.seconds))?;
    let stop = stop::on_signal()?;
    let specs: Vec<&EnvSpec> = if args.id == "all" { envs::specs().collect() } else { vec![envs::spec(&args.id)?] };
    let cores = Threads::new(0)?.count();
    let mut ways = vec![Way::InProcess { threads: 1 }];
    if cores > 1 {
        ways.push(Way::InProcess { threads: cores });
    }
    ways.extend([Way::ServiceReceives, Way::ServiceReads]);
    ways.extend(args.original.as_ref().map(|_| Way::Original));

    let measurements = specs.len() * ways.len() * usize::from(args.rounds);
    let bar = progress(measurements as u64, "measuring {bar:40} {pos}/{len}  {msg}");
    let mut rows = Vec::new();
    for spec in &specs {
        let mut results = vec![Vec::new(); ways.len()];
        for _ in 0..args.rounds {
            for (way, results) in ways.iter().zip(&mut results) {
                bar.set_message(format!("{}, {}", spec.id, name(*way)));
                results.push(measure(args, spec, *way, &stop)?);
                if stop.load(Ordering::Relaxed) {
                    return Err("stopped before all measurements were done".into());
                }
                bar.inc(1);
            }
        }
        rows.push(Row {
            environment: spec.id,
            num_envs: args.num_envs,
            service_threads: Threads::new(args.threads)?.count(),
            measurements: ways.iter().zip(results).map(|(way, results)| Measurement::new(*way, results)).collect(),
        });
    }
    bar.finish_and_clear();
    if args.json {
        print_json(&rows)?
    } else {
        show(args, &rows)
    }
    Ok(ExitCode::SUCCESS)
}

fn name(way: Way) -> String {
    match way {
        Way::InProcess { threads: 1 } => "in process, 1 thread".to_owned(),
        Way::InProcess { threads } => format!("in process, {threads} threads"),
        Way::ServiceReceives => "service, only receives".to_owned(),
        Way::ServiceReads => "service, reads every byte".to_owned(),
        Way::Original => "original".to_owned(),
    }
}

impl Measurement {
    fn new(way: Way, mut results: Vec<f64>) -> Self {
        results.sort_by(f64::total_cmp);
        let (lowest, highest) = (results[0], results[results.len() - 1]);
        Measurement { way: name(way), steps_per_second: results[results.len() / 2], lowest, highest }
    }
}

fn show(args: &Args, rows: &[Row]) {
    for row in rows {
        let plain = row.measurements[0].steps_per_second;
        let original = row.measurements.iter().find(|m| m.way == name(Way::Original)).map(|m| m.steps_per_second);
        let title = format!("{}, {} environments", row.environment, row.num_envs);
        let mut shown = table([&title, "steps per second", "lowest", "highest", "of 1 thread", "of the original"]);
        for measurement in &row.measurements {
            let speed = measurement.steps_per_second;
            shown.add_row([
                measurement.way.clone(),
                grouped(speed),
                grouped(measurement.lowest),
                grouped(measurement.highest),
                format!("{:.0} %", 100.0 * speed / plain),
                original.map_or("not measured".to_owned(), |original| format!("{:.0} x", speed / original)),
            ]);
        }
        print(format_args!("{shown}\n"));
    }
    let service = rows.first().map_or(1, |row| row.service_threads);
    let threads = if service == 1 { "1 thread".to_owned() } else { format!("{service} threads") };
    print(format_args!(
        "Medians of {} rounds of {} s. The service's engine steps with {threads} in a process of its own.",
        args.rounds, args.seconds
    ));
}

/// Steps per second in one way.
fn measure(args: &Args, spec: &'static EnvSpec, way: Way, stop: &AtomicBool) -> Result<f64, Failure> {
    match way {
        Way::InProcess { threads } => in_process(args, spec, threads, stop),
        Way::ServiceReceives => through_service(args, spec, false, stop),
        Way::ServiceReads => through_service(args, spec, true, stop),
        Way::Original => original(args, spec),
    }
}

/// Calls `step` until time is up, a few times first to warm up. Steps per second.
fn time(args: &Args, stop: &AtomicBool, mut step: impl FnMut() -> Result<(), Failure>) -> Result<f64, Failure> {
    const WARM_UP: usize = 20;
    for _ in 0..WARM_UP {
        step()?;
    }
    let (start, mut batches) = (Instant::now(), 0);
    while start.elapsed().as_secs_f64() < args.seconds && !stop.load(Ordering::Relaxed) {
        step()?;
        batches += 1;
    }
    Ok((batches * args.num_envs) as f64 / start.elapsed().as_secs_f64())
}

fn in_process(args: &Args, spec: &'static EnvSpec, threads: usize, stop: &AtomicBool) -> Result<f64, Failure> {
    let mut pool = Pool::new(&args.environment.configure(spec.id, args.num_envs)?, &Threads::new(threads)?)?;
    let mut blocks = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::All, &mut blocks)?;
    let mut actions = Actions::new(spec, args.num_envs);
    time(args, stop, || {
        pool.step(actions.next(), &mut blocks)?;
        Ok(())
    })
}

fn through_service(args: &Args, spec: &'static EnvSpec, reads: bool, stop: &AtomicBool) -> Result<f64, Failure> {
    let mut arguments = vec![
        format!("--env={}", spec.id),
        format!("--num-envs={}", args.num_envs),
        format!("--threads={}", args.threads),
    ];
    arguments.extend(args.environment.arguments());
    let mut engine = EngineProcess::start(&arguments)?;
    let mut trainer = engine.connect()?;
    let mut actions = Actions::new(spec, args.num_envs);
    trainer.reset(0, ResetRequest::All)?;
    time(args, stop, || {
        let received = trainer.receive(0, PATIENCE)?;
        if reads {
            std::hint::black_box(sum(&received.batch()));
        }
        // Given back before the next step is asked for, so that the engine writes to memory that is warm in its cache.
        drop(received);
        trainer.send(0, actions.next())?;
        Ok(())
    })
}

/// Random actions, drawn before the clock starts, as those of the original are.
struct Actions {
    numbers: Vec<i32>,
    /// Numbers of one environment, and of all.
    branches: usize,
    length: usize,
    step: usize,
}

impl Actions {
    /// Steps after which the same actions come again, in other states.
    const STEPS: usize = 1009;

    fn new(spec: &EnvSpec, num_envs: usize) -> Self {
        let branches = spec.action_space.branches().len();
        let mut numbers = vec![0; (num_envs + Self::STEPS) * branches];
        RandomPlayer::new(spec).act(&mut numbers);
        Actions { numbers, branches, length: num_envs * branches, step: 0 }
    }

    /// The actions of all environments in one step: each plays in this one what the one after it played in the last.
    fn next(&mut self) -> &[i32] {
        self.step = (self.step + 1) % Self::STEPS;
        &self.numbers[self.step * self.branches..][..self.length]
    }
}

/// Touches every byte of a batch.
fn sum(batch: &Batch<'_>) -> u64 {
    let words: &[u64] = bytemuck::cast_slice(batch.bytes());
    words.iter().fold(0, |sum, word| sum.wrapping_add(*word))
}

fn original(args: &Args, spec: &EnvSpec) -> Result<f64, Failure> {
    let python = args.original.as_deref().unwrap_or("python3");
    let output = Command::new(python)
        .args(["-c", ORIGINAL, spec.id, &args.seconds.to_string()])
        .output()
        .map_err(|error| format!("{python}: {error}"))?;
    let failed = || {
        let message = String::from_utf8_lossy(&output.stderr);
        format!("{python} cannot play the original: {}", message.trim().lines().last().unwrap_or("no message"))
    };
    let printed = String::from_utf8_lossy(&output.stdout);
    // The original's libraries print lines of their own first.
    Ok(printed.lines().last().and_then(|line| line.trim().parse().ok()).ok_or_else(failed)?)
}
