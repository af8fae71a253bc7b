//! `endless bench`.

use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use endless_gym_core::batch::{BLOCK_BYTES, Batch, BatchBuffer};
use endless_gym_core::envs::EnvSpec;
use endless_gym_core::pool::{Pool, Registry, ResetRequest, StepTimes, Threads};
use endless_gym_service::EngineConfig;
use serde::Serialize;
use serde_json::json;

use crate::engine_process::EngineProcess;
use crate::failure::Failure;
use crate::huge_pages;
use crate::options::{self, EnvironmentArgs};
use crate::output::{grouped, print, print_json, progress, table};
use crate::policies::RandomPolicy;
use crate::stop;

/// The Python script that measures the original.
const ORIGINAL: &str = include_str!("../../original.py");

/// Longest time that an engine may take for one step.
const STEP_TIMEOUT: Duration = Duration::from_secs(60);

/// Arguments of `endless bench`.
#[derive(clap::Args)]
pub struct Args {
    /// Environment id, or `all`.
    #[arg(long = "env", value_name = "ID")]
    id: String,
    /// Number of environments.
    #[arg(long, default_value_t = 1024)]
    pub num_envs: usize,
    /// Threads of the engine that serves the environments; 0 for one per core. Several numbers, such as `1,2,4,8`, print how speed
    /// grows with the threads instead, in process and through the service, and where the time of a step goes.
    #[arg(long, value_name = "N,..", value_delimiter = ',', default_value = "1")]
    pub threads: Vec<usize>,
    /// Bind each thread to a CPU of its own, as `endless serve --pin-threads` does; in process, all but the calling one.
    #[arg(long)]
    pin_threads: bool,
    /// Duration of one measurement in seconds.
    #[arg(long, default_value_t = 1.0)]
    pub seconds: f64,
    /// Measurements of each method, at least 1.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..))]
    pub rounds: u16,
    /// Also measure the original, with the first of these Python interpreters that has it, `memory-gym` or `popgym` [default: the
    /// original is not measured].
    #[arg(long, value_name = "PYTHON,..", value_delimiter = ',')]
    original: Vec<String>,
    #[command(flatten)]
    environment: EnvironmentArgs,
    /// Print JSON [default: text].
    #[arg(long)]
    pub json: bool,
}

impl Args {
    /// Whether speeds with different numbers of threads are to be compared.
    pub fn compares_threads(&self) -> bool {
        self.threads.len() > 1
    }

    /// The environments to measure, and the flag that a signal sets.
    pub fn check<'a>(&self, registry: &'a Registry) -> Result<(Vec<&'a EnvSpec>, &'static AtomicBool), Failure> {
        options::seconds("--seconds", self.seconds)?;
        let stop = stop::on_signal()?;
        let one = self.id != "all";
        Ok((if one { vec![registry.spec(&self.id)?] } else { registry.specs().collect() }, stop))
    }
}

/// How environments are stepped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Method {
    /// A pool in this process.
    InProcess { threads: usize },
    /// An engine in a child process, and a trainer that does not read the batches.
    ServiceReceives,
    /// An engine in a child process, and a trainer that reads every byte of every batch.
    ServiceReads,
    /// The original, in Python.
    Original,
}

/// The measurements of one environment.
#[derive(Serialize)]
struct Row {
    environment: &'static str,
    num_envs: usize,
    service_threads: usize,
    measurements: Vec<Measurement>,
}

#[derive(Serialize)]
struct Measurement {
    method: String,
    /// Median of the rounds.
    steps_per_second: f64,
    lowest: f64,
    highest: f64,
    /// Bytes of one batch.
    batch_bytes: Option<usize>,
    /// Bytes of batches that are in huge pages; with the service, of all the engine's batches. `None` if the system
    /// does not report them.
    huge_page_bytes: Option<u64>,
}

/// The result of one round.
#[derive(Clone, Copy, Default)]
pub struct Round {
    pub steps_per_second: f64,
    batch_bytes: Option<usize>,
    huge_page_bytes: Option<u64>,
    /// Of an in-process measurement with several threads.
    pub times: StepTimes,
}

/// Runs `endless bench`.
pub fn run(registry: &Registry, args: &Args) -> Result<(), Failure> {
    let (specs, stop) = args.check(registry)?;
    let cores = Threads::new(0)?.count();
    let service_threads = args.threads[0];
    let mut methods = vec![Method::InProcess { threads: 1 }];
    if cores > 1 {
        methods.push(Method::InProcess { threads: cores });
    }
    methods.extend([Method::ServiceReceives, Method::ServiceReads]);
    methods.extend((!args.original.is_empty()).then_some(Method::Original));

    let measurements = specs.len() * methods.len() * usize::from(args.rounds);
    let bar = progress(measurements as u64, "measuring {bar:40} {pos}/{len}  {msg}");
    let mut rows = Vec::new();
    for spec in &specs {
        let mut results = vec![Vec::new(); methods.len()];
        for _ in 0..args.rounds {
            for (method, results) in methods.iter().zip(&mut results) {
                bar.set_message(format!("{}, {}", spec.id, name(*method)));
                results.push(measure(registry, args, spec, *method, service_threads, stop)?);
                bar.inc(1);
            }
        }
        rows.push(Row {
            environment: spec.id,
            num_envs: args.num_envs,
            service_threads: Threads::new(service_threads)?.count(),
            measurements: methods
                .iter()
                .zip(results)
                .map(|(method, results)| Measurement::new(*method, results))
                .collect(),
        });
    }
    bar.finish_and_clear();
    if args.json { print_json(&rows) } else { show(args, &rows) }
}

fn name(method: Method) -> String {
    match method {
        Method::InProcess { threads: 1 } => "in process, 1 thread".to_owned(),
        Method::InProcess { threads } => format!("in process, {threads} threads"),
        Method::ServiceReceives => "service, only receives".to_owned(),
        Method::ServiceReads => "service, reads every byte".to_owned(),
        Method::Original => "original".to_owned(),
    }
}

impl Measurement {
    fn new(method: Method, mut rounds: Vec<Round>) -> Self {
        rounds.sort_by(|a, b| a.steps_per_second.total_cmp(&b.steps_per_second));
        let median = rounds[rounds.len() / 2];
        Measurement {
            method: name(method),
            steps_per_second: median.steps_per_second,
            lowest: rounds[0].steps_per_second,
            highest: rounds[rounds.len() - 1].steps_per_second,
            batch_bytes: median.batch_bytes,
            huge_page_bytes: median.huge_page_bytes,
        }
    }
}

/// Prints one table for each environment.
fn show(args: &Args, rows: &[Row]) -> Result<(), Failure> {
    for row in rows {
        let plain = row.measurements[0].steps_per_second;
        let original = row.measurements.iter().find(|m| m.method == name(Method::Original)).map(|m| m.steps_per_second);
        let title = format!("{}, {} environments", row.environment, row.num_envs);
        let mut shown = table([&title, "steps per second", "lowest", "highest", "of 1 thread", "of the original"]);
        for measurement in &row.measurements {
            let speed = measurement.steps_per_second;
            shown.add_row([
                measurement.method.clone(),
                grouped(speed),
                grouped(measurement.lowest),
                grouped(measurement.highest),
                format!("{:.0} %", 100.0 * speed / plain),
                original.map_or("not measured".to_owned(), |original| format!("{:.0} x", speed / original)),
            ]);
        }
        print(format_args!("{shown}\n{}\n", memory(row)))?;
    }
    let service = rows.first().map_or(1, |row| row.service_threads);
    let threads = if service == 1 { "1 thread".to_owned() } else { format!("{service} threads") };
    print(format_args!(
        "Medians of {} rounds of {} s each. The service's engine runs with {threads} in a child process.",
        args.rounds, args.seconds
    ))
}

/// How much of the batches' memory was in huge pages in the first in-process measurement and the first with the
/// service.
fn memory(row: &Row) -> String {
    let megabytes = |bytes: Option<u64>| {
        bytes.map_or("an unknown number of".to_owned(), |bytes| format!("{:.1}", bytes as f64 / 1e6))
    };
    let of = |method: Method| row.measurements.iter().find(|measurement| measurement.method == name(method));
    let huge = |method: Method| megabytes(of(method).and_then(|measurement| measurement.huge_page_bytes));
    let in_process = Method::InProcess { threads: 1 };
    format!(
        "A batch has {} MB. In huge pages: {} MB of it in process, {} MB of the engine's shared memory.",
        megabytes(of(in_process).and_then(|measurement| measurement.batch_bytes).map(|bytes| bytes as u64)),
        huge(in_process),
        huge(Method::ServiceReceives)
    )
}

/// One round of one method.
fn measure(
    registry: &Registry,
    args: &Args,
    spec: &EnvSpec,
    method: Method,
    service_threads: usize,
    stop: &AtomicBool,
) -> Result<Round, Failure> {
    match method {
        Method::InProcess { threads } => in_process(registry, args, spec, &Threads::new(threads)?, stop),
        Method::ServiceReceives => through_service(args, spec, false, service_threads, stop),
        Method::ServiceReads => through_service(args, spec, true, service_threads, stop),
        Method::Original => Ok(Round { steps_per_second: original(args, spec)?, ..Round::default() }),
    }
}

/// Calls `step` for `--seconds` after a few warm-up calls and `warm`, and returns the steps per second of all environments.
fn time(
    args: &Args,
    stop: &AtomicBool,
    warm: impl FnOnce(),
    mut step: impl FnMut() -> Result<(), Failure>,
) -> Result<f64, Failure> {
    const WARM_UP: usize = 20;
    for _ in 0..WARM_UP {
        step()?;
    }
    warm();
    let (start, mut batches) = (Instant::now(), 0);
    while start.elapsed().as_secs_f64() < args.seconds && !stop.load(Ordering::Relaxed) {
        step()?;
        batches += 1;
    }
    if stop.load(Ordering::Relaxed) {
        return Err("stopped before all measurements were done".into());
    }
    Ok((batches * args.num_envs) as f64 / start.elapsed().as_secs_f64())
}

pub fn in_process(
    registry: &Registry,
    args: &Args,
    spec: &EnvSpec,
    threads: &Threads,
    stop: &AtomicBool,
) -> Result<Round, Failure> {
    if args.pin_threads {
        threads.pin(0)?;
    }
    let mut pool = Pool::new(registry, &args.environment.configure(spec.id, args.num_envs)?, threads)?;
    let mut actions = Actions::new(spec, args.num_envs);
    let before = huge_pages::bytes(std::process::id(), huge_pages::PRIVATE);
    let mut blocks = BatchBuffer::new(pool.layout().blocks());
    pool.reset(ResetRequest::All, &mut blocks)?;
    let after = huge_pages::bytes(std::process::id(), huge_pages::PRIVATE);
    let restart = || {
        threads.take_times();
    };
    let steps_per_second = time(args, stop, restart, || {
        pool.step(actions.next(), &mut blocks)?;
        Ok(())
    })?;
    Ok(Round {
        steps_per_second,
        batch_bytes: Some(blocks.len() * BLOCK_BYTES),
        huge_page_bytes: after.zip(before).map(|(after, before)| after.saturating_sub(before)),
        times: threads.take_times().unwrap_or_default(),
    })
}

pub fn through_service(
    args: &Args,
    spec: &EnvSpec,
    reads: bool,
    threads: usize,
    stop: &AtomicBool,
) -> Result<Round, Failure> {
    let pool = args.environment.configure(spec.id, args.num_envs)?;
    let mut engine = EngineProcess::start(EngineConfig::new("endless", pool, threads).pin_threads(args.pin_threads))?;
    let mut trainer = engine.connect(stop)?;
    let mut actions = Actions::new(spec, args.num_envs);
    trainer.reset(0, ResetRequest::All)?;
    let mut batch_bytes = None;
    let steps_per_second = time(
        args,
        stop,
        || {},
        || {
            let received = trainer.receive(0, STEP_TIMEOUT)?;
            batch_bytes = Some(received.batch().bytes().len());
            if reads {
                std::hint::black_box(sum(&received.batch()));
            }
            // Release the lease before the next step, so that the engine writes to memory that is still in its cache.
            drop(received);
            trainer.send(0, actions.next())?;
            Ok(())
        },
    )?;
    let huge_page_bytes = huge_pages::bytes(engine.id(), huge_pages::SHARED);
    Ok(Round { steps_per_second, batch_bytes, huge_page_bytes, ..Round::default() })
}

/// Random actions drawn before the measurement, as in `original.py`.
struct Actions {
    numbers: Vec<i32>,
    /// Numbers in the action of one environment.
    branches: usize,
    /// Numbers in the actions of all environments.
    length: usize,
    step: usize,
}

impl Actions {
    /// Steps after which the actions repeat.
    const STEPS: usize = 1009;

    fn new(spec: &EnvSpec, num_envs: usize) -> Self {
        let branches = spec.action_space.width();
        let mut numbers = vec![0; (num_envs + Self::STEPS) * branches];
        RandomPolicy::new(spec, 0).act(&mut numbers);
        Actions { numbers, branches, length: num_envs * branches, step: 0 }
    }

    /// The actions of all environments in the next step: those of the last step, shifted by one environment.
    fn next(&mut self) -> &[i32] {
        self.step = (self.step + 1) % Self::STEPS;
        &self.numbers[self.step * self.branches..][..self.length]
    }
}

/// The sum of a batch's bytes, read as 64-bit words. Each iteration reads a cache line, since the speed of a shorter
/// loop depends on its address. A batch is a whole number of cache lines.
fn sum(batch: &Batch<'_>) -> u64 {
    let words: &[u64] = bytemuck::cast_slice(batch.bytes());
    let sums =
        words.as_chunks().0.iter().fold([0_u64; 8], |sums, line: &[u64; 8]| {
            std::array::from_fn(|place| sums[place].wrapping_add(line[place]))
        });
    sums.iter().fold(0, |sum, part| sum.wrapping_add(*part))
}

/// Steps per second of the original, by the first Python that can measure it.
fn original(args: &Args, spec: &EnvSpec) -> Result<f64, Failure> {
    let mut reasons = Vec::new();
    for python in &args.original {
        match original_by(python, args, spec) {
            Ok(speed) => return Ok(speed),
            Err(reason) => reasons.push(reason.to_string()),
        }
    }
    Err(reasons.join("; ").into())
}

fn original_by(python: &str, args: &Args, spec: &EnvSpec) -> Result<f64, Failure> {
    let output = Command::new(python)
        .args(["-c", ORIGINAL, spec.id, &args.seconds.to_string(), &json!(spec.arguments).to_string()])
        .output()
        .map_err(|error| format!("cannot run {python}: {error}"))?;
    let failed = || {
        let message = String::from_utf8_lossy(&output.stderr);
        let version = if message.contains("SyntaxError") { "; it must be a Python 3" } else { "" };
        let last = message.trim().lines().last().unwrap_or("no message");
        format!("{python} cannot measure the original: {last}{version}")
    };
    let printed = String::from_utf8_lossy(&output.stdout);
    // The original's libraries print other lines first.
    Ok(printed.lines().last().and_then(|line| line.trim().parse().ok()).ok_or_else(failed)?)
}
