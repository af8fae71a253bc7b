//! `endless status`.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use endless_gym_service::{
    ConnectConfig, EngineProcesses, EngineStatus, GroupStatus, Namespace, Observers, ServiceError,
};
use endless_gym_view::RecentEpisodes;
use serde_json::{Value as Json, json};

use crate::failure::Failure;
use crate::options::seconds;
use crate::output::{clear, fit, grouped, print, print_json, print_json_line, table};
use crate::stop;

/// Time between the two readings from which steps per second are computed, unless `--watch` sets it.
const INTERVAL: Duration = Duration::from_millis(250);

/// Longest wait for a batch between checks of the stop flag.
const SLICE: Duration = Duration::from_millis(50);

/// Arguments of `endless status`.
#[derive(clap::Args)]
pub struct Args {
    /// Name of the engine [default: all running engines].
    service: Option<String>,
    /// Print JSON [default: text]. With `--watch`, a line for each reading.
    #[arg(long)]
    json: bool,
    /// Repeat every SECONDS, until Ctrl-C or the end of the named engine, whose episodes are then observed: their mean return and
    /// length are those of the last 1,000.
    #[arg(long, value_name = "SECONDS", num_args = 0..=1, default_missing_value = "1")]
    watch: Option<f64>,
}

/// The status of an engine at one time, and its steps per second since the previous reading.
struct Reading {
    status: EngineStatus,
    processes: EngineProcesses,
    shared_memory: Option<u64>,
    steps_per_second: f64,
}

/// Runs `endless status`.
pub fn run(args: &Args) -> Result<(), Failure> {
    let namespace = Namespace::default();
    let mut before = (Instant::now(), read(args, &namespace)?);
    let Some(given) = args.watch else {
        thread::sleep(INTERVAL);
        return show(args, &readings(args, &namespace, &before)?, None);
    };
    let (interval, stop) = (seconds("--watch", given)?, stop::on_signal()?);
    let connect = |service: &String| Observers::connect(&ConnectConfig::new(service), None);
    let mut observers = args.service.as_ref().map(connect).transpose()?;
    let mut episodes = RecentEpisodes::default();
    loop {
        if is_stopped(stop, interval, observers.as_mut(), &mut episodes)? {
            return Ok(());
        }
        let Ok(readings) = readings(args, &namespace, &before) else {
            return if args.json { Ok(()) } else { print("the engine has ended") };
        };
        if !args.json {
            clear()?;
        }
        show(args, &readings, episodes.means())?;
        before = (Instant::now(), readings.into_iter().map(|reading| reading.status).collect());
    }
}

/// Waits and adds the episodes that end. Returns whether a signal came.
fn is_stopped(
    stop: &AtomicBool,
    interval: Duration,
    observers: Option<&mut Observers>,
    episodes: &mut RecentEpisodes,
) -> Result<bool, Failure> {
    let end = Instant::now() + interval;
    let left = || end.saturating_duration_since(Instant::now());
    if let Some(observers) = observers {
        while !stop.load(Ordering::Relaxed) && !left().is_zero() {
            match observers.next(SLICE.min(left())) {
                Ok(observed) => episodes.add(&observed.lease.batch()),
                Err(ServiceError::TimedOut { .. }) => {}
                Err(ServiceError::EngineLost { .. }) => break,
                Err(error) => return Err(error.into()),
            }
        }
    }
    Ok(stop::wait(stop, left()))
}

/// The status of the requested engines.
fn read(args: &Args, namespace: &Namespace) -> Result<Vec<EngineStatus>, Failure> {
    let mut found = EngineStatus::all(namespace);
    let Some(service) = &args.service else { return Ok(found) };
    let names: Vec<_> = found.iter().map(|status| status.service.clone()).collect();
    found.retain(|status| status.service == *service);
    if found.is_empty() {
        let names = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        let root = namespace.root().display();
        return Err(format!("no engine `{service}` is running in {root}; running engines: {names}").into());
    }
    Ok(found)
}

/// Reads again, and compares with the previous reading.
fn readings(
    args: &Args,
    namespace: &Namespace,
    (moment, before): &(Instant, Vec<EngineStatus>),
) -> Result<Vec<Reading>, Failure> {
    let found = read(args, namespace)?;
    let passed = moment.elapsed().as_secs_f64();
    let readings = found.into_iter().map(|status| {
        let earlier = before.iter().find(|earlier| earlier.incarnation == status.incarnation);
        let steps = env_steps(&status).saturating_sub(earlier.map_or(0, env_steps));
        let passed = if earlier.is_some() { passed } else { status.uptime.as_secs_f64() };
        Reading {
            processes: status.processes(namespace),
            shared_memory: status.shared_memory(namespace),
            steps_per_second: steps as f64 / passed.max(1e-3),
            status,
        }
    });
    Ok(readings.collect())
}

fn env_steps(status: &EngineStatus) -> u64 {
    status.total(|group| group.env_steps)
}

/// Prints the readings, and the mean return and length of the episodes of the named engine.
fn show(args: &Args, readings: &[Reading], means: Option<(f64, f64)>) -> Result<(), Failure> {
    match readings {
        _ if args.json => {
            let mut all = readings.iter().map(as_json).collect::<Result<Vec<_>, _>>()?;
            if args.watch.is_none() {
                return print_json(&all);
            }
            if args.service.is_some() {
                all[0]["mean_return"] = json!(means.map(|(mean, _)| mean));
                all[0]["mean_length"] = json!(means.map(|(_, mean)| mean));
            }
            print_json_line(&all)
        }
        [] => print("no engine is running"),
        [one] if args.service.is_some() => {
            let means = means.map_or_else(String::new, |(mean_return, mean_length)| {
                format!("\nmean return {mean_return:.3}, mean length {mean_length:.1}")
            });
            print(format_args!("{}\n\n{}{means}", engines(readings), groups(&one.status)))
        }
        _ => print(engines(readings)),
    }
}

fn as_json(reading: &Reading) -> Result<Json, Failure> {
    let mut value = serde_json::to_value(&reading.status)?;
    // As text, since not every JSON reader keeps 64 bits.
    value["incarnation"] = json!(format!("{:016x}", reading.status.incarnation));
    value["env_steps"] = json!(env_steps(&reading.status));
    value["episodes"] = json!(reading.status.total(|group| group.episodes));
    value["steps_per_second"] = json!(reading.steps_per_second);
    value["shared_memory_bytes"] = json!(reading.shared_memory);
    value["trainers"] = json!(reading.processes.trainers);
    value["observers"] = json!(reading.processes.observers);
    Ok(value)
}

/// One row for each engine: what it has done, and below it who uses it.
fn engines(readings: &[Reading]) -> String {
    let mut work = table(["engine", "environment", "process", "up", "envs", "steps", "per second", "episodes"]);
    let mut users = table([
        "engine",
        "trainer",
        "observers",
        "held batches",
        "held by observers",
        "shared memory",
        "recoveries",
        "last message",
        "busy",
    ]);
    for Reading { status, processes, shared_memory, steps_per_second } in readings {
        work.add_row([
            status.service.clone(),
            status.id.clone(),
            status.process.to_string(),
            duration(Some(status.uptime)),
            format!("{} x {}", status.groups.len(), status.num_envs),
            grouped(env_steps(status) as f64),
            grouped(*steps_per_second),
            grouped(status.total(|group| group.episodes) as f64),
        ]);
        users.add_row([
            status.service.clone(),
            list(&processes.trainers),
            list(&processes.observers),
            status.total(|group| u64::from(group.held)).to_string(),
            status.total(GroupStatus::held_by_observers).to_string(),
            shared_memory.map_or_else(|| "-".to_owned(), |bytes| format!("{} MB", bytes.div_ceil(1_000_000))),
            status.recoveries.to_string(),
            duration(status.groups.iter().filter_map(|group| group.last_request).min()),
            duration(status.groups.iter().filter_map(|group| group.busy).max()),
        ]);
    }
    format!("{}\n\n{}", fit(work), fit(users))
}

fn list(processes: &BTreeSet<u32>) -> String {
    let texts: Vec<_> = processes.iter().map(u32::to_string).collect();
    if texts.is_empty() { "-".to_owned() } else { texts.join(" ") }
}

/// One row for each group of an engine.
fn groups(status: &EngineStatus) -> String {
    let mut rows = table([
        "group",
        "batch",
        "steps",
        "episodes",
        "rejected",
        "held",
        "held by observers",
        "last request",
        "since",
        "busy",
    ]);
    for (number, group) in status.groups.iter().enumerate() {
        rows.add_row([
            number.to_string(),
            grouped(group.step as f64),
            grouped(group.env_steps as f64),
            grouped(group.episodes as f64),
            grouped(group.rejected as f64),
            group.held.to_string(),
            group.held_by_observers().to_string(),
            group.kind.unwrap_or("-").to_owned(),
            duration(group.last_request),
            duration(group.busy),
        ]);
    }
    let incarnation = status.incarnation;
    let saved = match status.last_checkpoint {
        Some(_) => format!(", {} checkpoints, the last {} ago", status.checkpoints, duration(status.last_checkpoint)),
        None => String::new(),
    };
    format!("{}\n\nincarnation {incarnation:016x}{saved}", fit(rows))
}

/// A duration for people: `0.3s`, `12s`, `5m 3s`, `2h 5m`, `3d 2h`.
fn duration(given: Option<Duration>) -> String {
    let Some(given) = given else { return "-".to_owned() };
    match given.as_secs() {
        0..10 => format!("{:.1}s", given.as_secs_f64()),
        s @ 10..60 => format!("{s}s"),
        s @ 60..3600 => format!("{}m {}s", s / 60, s % 60),
        s @ 3600..86_400 => format!("{}h {}m", s / 3600, s % 3600 / 60),
        s => format!("{}d {}h", s / 86_400, s % 86_400 / 3600),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_have_two_units_at_most() {
        let text = |seconds: f64| duration(Some(Duration::from_secs_f64(seconds)));
        let given = [0.0, 9.94, 10.9, 303.0, 7500.0, 270_000.0].map(text);
        assert_eq!(given, ["0.0s", "9.9s", "10s", "5m 3s", "2h 5m", "3d 3h"]);
        assert_eq!(duration(None), "-");
    }
}
