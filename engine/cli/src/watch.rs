//! `endless watch`: statistics of a training run, from an observer, in one line.

use std::io::{self, IsTerminal};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use endless_gym_service::{ConnectConfig, ErrorKind, Namespace, Observed, Observers, ServiceError, running_engines};
use endless_gym_view::RecentEpisodes;
use serde_json::json;

use super::failure::Failure;
use super::options::seconds;
use super::output::{end_line, grouped, print, print_json_line, replace_line};
use super::stop;

/// Seconds between updates of the line in a terminal, and between lines elsewhere, unless `--interval` sets them.
const LIVE_INTERVAL: f64 = 0.25;
const LINE_INTERVAL: f64 = 1.0;

/// Longest wait between checks of the stop flag.
const SLICE: Duration = Duration::from_millis(50);

/// Arguments of `endless watch`.
#[derive(clap::Args)]
pub struct Args {
    /// Name of the engine [default: the only running engine, or `endless`].
    service: Option<String>,
    /// Watch this group only [default: all].
    #[arg(long)]
    group: Option<usize>,
    /// Seconds between lines [default: 1; 0.25 between updates of the line in a terminal].
    #[arg(long, value_name = "SECONDS")]
    interval: Option<f64>,
    /// How long to wait for the engine to start, in seconds.
    #[arg(long, value_name = "SECONDS", default_value_t = 1.0)]
    timeout: f64,
    /// Print one JSON document in each line [default: text].
    #[arg(long)]
    json: bool,
}

/// Statistics of the batches observed so far.
pub struct Statistics {
    num_envs: u64,
    /// Batches of all groups, including missed ones.
    batches: u64,
    missed: u64,
    pub episodes: RecentEpisodes,
    /// The time of the last batch.
    last: Instant,
    /// When the rate was last computed, and the batches then.
    since: (Instant, u64),
}

impl Statistics {
    /// Empty statistics, for groups with that number of environments.
    pub fn new(num_envs: usize) -> Self {
        let now = Instant::now();
        Statistics {
            num_envs: num_envs as u64,
            batches: 0,
            missed: 0,
            episodes: RecentEpisodes::default(),
            last: now,
            since: (now, 0),
        }
    }

    /// Adds a batch.
    pub fn add(&mut self, observed: &Observed) {
        self.batches += observed.missed.saturating_add(1);
        self.missed += observed.missed;
        self.last = Instant::now();
        self.episodes.add(&observed.lease.batch());
    }

    /// Environment steps so far.
    pub fn steps(&self) -> u64 {
        self.batches * self.num_envs
    }

    /// Environment steps per second since the last call.
    fn rate(&mut self) -> f64 {
        let (moment, before) = std::mem::replace(&mut self.since, (Instant::now(), self.batches));
        ((self.batches - before) * self.num_envs) as f64 / moment.elapsed().as_secs_f64().max(1e-3)
    }
}

/// Runs `endless watch`.
pub fn run(args: &Args) -> Result<(), Failure> {
    let is_live = !args.json && io::stdout().is_terminal();
    let interval = seconds("--interval", args.interval.unwrap_or(if is_live { LIVE_INTERVAL } else { LINE_INTERVAL }))?;
    let timeout = seconds("--timeout", args.timeout)?;
    let stop = stop::on_signal()?;
    let service = named_or_only(args.service.as_deref())?;
    let Some(mut observers) = connect(&service, args.group, timeout, stop)? else { return Ok(()) };
    let mut statistics = Statistics::new(observers.specification().num_envs);
    let id = observers.specification().id.clone();
    let mut shown = Instant::now();
    loop {
        let is_over = match observers.next(SLICE.min(interval)) {
            Ok(observed) => {
                statistics.add(&observed);
                false
            }
            Err(ServiceError::TimedOut { .. }) => false,
            Err(ServiceError::EngineLost { .. }) => true,
            Err(error) => {
                end_line(is_live)?;
                return Err(error.into());
            }
        };
        let is_stopped = stop.load(Ordering::Relaxed);
        if is_over || is_stopped || shown.elapsed() >= interval {
            shown = Instant::now();
            show(args, &service, is_live, &id, &mut statistics, is_over)?;
        }
        if is_over || is_stopped {
            end_line(is_live)?;
            return if is_over && !args.json { print("the engine has ended") } else { Ok(()) };
        }
    }
}

/// The name of an engine, by default of the only one that runs. `endless` is meant if it runs among others, or may start.
pub fn named_or_only(service: Option<&str>) -> Result<String, Failure> {
    const DEFAULT: &str = "endless";
    if let Some(service) = service {
        return Ok(service.to_owned());
    }
    let mut running = running_engines(&Namespace::default())?;
    match running.len() {
        1 => Ok(running.remove(0)),
        0 => Ok(DEFAULT.to_owned()),
        _ if running.iter().any(|name| name == DEFAULT) => Ok(DEFAULT.to_owned()),
        _ => Err(format!("several engines run: {}; give the name of one", running.join(", ")).into()),
    }
}

/// The observers, or `None` if a signal came while waiting for the engine.
pub fn connect(
    service: &str,
    group: Option<usize>,
    timeout: Duration,
    stop: &AtomicBool,
) -> Result<Option<Observers>, Failure> {
    let start = Instant::now();
    loop {
        let left = timeout.saturating_sub(start.elapsed());
        let config = ConnectConfig::new(service).timeout(left.min(SLICE));
        match Observers::connect(&config, group) {
            Err(error) if left > SLICE && matches!(error.kind(), ErrorKind::Unavailable | ErrorKind::Lost) => {}
            connected => return Ok(Some(connected?)),
        }
        if stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
    }
}

fn show(
    args: &Args,
    service: &str,
    is_live: bool,
    id: &str,
    statistics: &mut Statistics,
    is_over: bool,
) -> Result<(), Failure> {
    let rate = statistics.rate();
    let (means, idle) = (statistics.episodes.means(), statistics.last.elapsed());
    if args.json {
        return print_json_line(&json!({
            "service": service,
            "environment": id,
            "steps_per_second": rate,
            "batches": statistics.batches,
            "missed": statistics.missed,
            "episodes": statistics.episodes.ended,
            "mean_return": means.map(|(mean, _)| mean),
            "mean_length": means.map(|(_, mean)| mean),
            "idle_seconds": idle.as_secs_f64(),
            "ended": is_over,
        }));
    }
    let mut text = format!("{service} {id}: {} steps/s", grouped(rate));
    text += &format!(", {} episodes", grouped(statistics.episodes.ended as f64));
    if let Some((mean_return, mean_length)) = means {
        text += &format!(", mean return {mean_return:.3}, mean length {mean_length:.1}");
    }
    text +=
        &format!(", {} of {} batches missed", grouped(statistics.missed as f64), grouped(statistics.batches as f64));
    if idle >= Duration::from_secs(2) {
        text += &format!(", idle for {} s", idle.as_secs());
    }
    if is_live { replace_line(&text) } else { print(text) }
}
