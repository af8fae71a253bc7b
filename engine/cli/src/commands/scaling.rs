//! How speed grows with the threads, and where the time of a step goes.

use std::time::Duration;

use endless_gym_core::pool::{Registry, Threads};
use serde::Serialize;

use crate::commands::bench::{Args, Round, in_process, through_service};
use crate::failure::Failure;
use crate::output::{fit, grouped, print, print_json, progress, table};

/// The measurements of one environment.
#[derive(Serialize)]
struct Scaling {
    environment: &'static str,
    num_envs: usize,
    cores: usize,
    threads: Vec<Row>,
}

/// The measurement with one number of threads. Durations are microseconds of a step.
#[derive(Serialize)]
struct Row {
    threads: usize,
    /// In process; median of the rounds.
    steps_per_second: f64,
    /// Of that many times the speed of one thread.
    efficiency: f64,
    step: f64,
    /// Where the step's time went; `None` if the calling thread stepped alone.
    parts: Option<Parts>,
    /// Through the service, with a trainer that does not read the batches; median of the rounds.
    service_steps_per_second: f64,
    /// Of the speed in process.
    service_ratio: f64,
}

/// The parts of a step, without `last_join`, add up to it.
#[derive(Serialize)]
struct Parts {
    /// What the calling thread did before and after the threads worked: checks of the actions, waking the workers.
    opening: f64,
    /// Mean time until a thread joined.
    joining: f64,
    /// Time until the last thread joined.
    last_join: f64,
    /// Mean time that a thread stepped environments.
    work: f64,
    /// Mean time that a thread waited for the slowest.
    waiting: f64,
}

/// Measures each environment with each number of threads, and with one.
pub fn run(registry: &Registry, args: &Args) -> Result<(), Failure> {
    let ((specs, stop), cores) = (args.check(registry)?, Threads::new(0)?.count());
    let mut counts: Vec<usize> = args.threads.iter().map(|count| if *count == 0 { cores } else { *count }).collect();
    counts.push(1);
    counts.sort_unstable();
    counts.dedup();
    let measurements = 2 * specs.len() * counts.len() * usize::from(args.rounds);
    let bar = progress(measurements as u64, "measuring {bar:40} {pos}/{len}  {msg}");
    let mut scalings = Vec::new();
    for spec in &specs {
        let mut rounds = vec![(Vec::new(), Vec::new()); counts.len()];
        for _ in 0..args.rounds {
            for (count, (here, served)) in counts.iter().zip(&mut rounds) {
                bar.set_message(format!("{}, {count} threads", spec.id));
                here.push(in_process(registry, args, spec, &Threads::timed(*count)?, stop)?);
                bar.inc(1);
                served.push(through_service(args, spec, false, *count, stop)?);
                bar.inc(1);
            }
        }
        let medians: Vec<_> = rounds.into_iter().map(|(here, served)| (median(here), median(served))).collect();
        let alone = medians[0].0.steps_per_second;
        let rows =
            counts.iter().zip(medians).map(|(count, (here, served))| Row::new(args, *count, alone, here, served));
        scalings.push(Scaling { environment: spec.id, num_envs: args.num_envs, cores, threads: rows.collect() });
    }
    bar.finish_and_clear();
    if args.json { print_json(&scalings) } else { scalings.iter().try_for_each(|scaling| show(args, scaling)) }
}

/// The round of median speed.
fn median(mut rounds: Vec<Round>) -> Round {
    rounds.sort_by(|a, b| a.steps_per_second.total_cmp(&b.steps_per_second));
    rounds[rounds.len() / 2]
}

impl Row {
    fn new(args: &Args, threads: usize, alone: f64, here: Round, served: Round) -> Self {
        let step = 1e6 * args.num_envs as f64 / here.steps_per_second;
        let times = here.times;
        let parts = (times.steps > 0).then(|| {
            let mean = |time: Duration| time.as_secs_f64() * 1e6 / times.steps as f64;
            let (joining, work, waiting) = (mean(times.joining), mean(times.working), mean(times.waiting));
            let opening = step - joining - work - waiting;
            Parts { opening, joining, last_join: mean(times.last_join), work, waiting }
        });
        Row {
            threads,
            steps_per_second: here.steps_per_second,
            efficiency: here.steps_per_second / (threads as f64 * alone),
            step,
            parts,
            service_steps_per_second: served.steps_per_second,
            service_ratio: served.steps_per_second / here.steps_per_second,
        }
    }
}

fn show(args: &Args, scaling: &Scaling) -> Result<(), Failure> {
    let Scaling { environment, num_envs, cores, threads: rows } = scaling;
    let mut shown = table([
        "threads",
        "steps/s",
        "efficiency",
        "step µs",
        "opening",
        "joining",
        "last join",
        "work",
        "waiting",
        "service",
        "ratio",
    ]);
    for row in rows {
        let part = |part: fn(&Parts) -> f64| row.parts.as_ref().map_or("-".to_owned(), |p| format!("{:.1}", part(p)));
        shown.add_row([
            row.threads.to_string(),
            grouped(row.steps_per_second),
            format!("{:.0} %", 100.0 * row.efficiency),
            format!("{:.1}", row.step),
            part(|parts| parts.opening),
            part(|parts| parts.joining),
            part(|parts| parts.last_join),
            part(|parts| parts.work),
            part(|parts| parts.waiting),
            grouped(row.service_steps_per_second),
            format!("{:.0} %", 100.0 * row.service_ratio),
        ]);
    }
    print(format_args!("{environment}, {num_envs} environments, {cores} cores\n\n{}\n", fit(shown)))?;
    if rows.iter().any(|row| row.threads >= *cores) {
        print(format_args!(
            "With {cores} threads, the service's trainer shares a core with one; with more, all take turns."
        ))?;
    }
    print(format_args!(
        "In process and through the service in steps/s. Microseconds of a step: opening and closing by the calling thread alone; joining, work and waiting for the slowest as means \
         over the threads. Medians of {} rounds of {} s each.",
        args.rounds, args.seconds
    ))
}
