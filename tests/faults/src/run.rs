//! A run: successive rounds, each in a new process and namespace.

use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use endless_gym_core::random::entropy;
use endless_gym_service::{Namespace, ROOT_VARIABLE};
use rustix::process::Signal;

use crate::actors;
use crate::cleanliness;
use crate::plan::Plan;
use crate::report::{Failure, Outcome};
use crate::rights::Rights;
use crate::round;

/// Longer than any round takes.
const ROUND_LIMIT: Duration = Duration::from_secs(1800);

/// Arguments of `faults`.
#[derive(clap::Args)]
pub struct Args {
    /// Duration of the run.
    #[arg(long, default_value_t = 2.0)]
    minutes: f64,
    /// The seed of all rounds [default: random].
    #[arg(long)]
    seed: Option<u64>,
    /// Stop after this many faults.
    #[arg(long)]
    faults: Option<usize>,
    /// Play only this round.
    #[arg(long)]
    round: Option<u64>,
}

/// Runs `faults`.
pub fn run(args: &Args) -> Result<(), String> {
    actors::engine_program()?;
    let time = duration(args.minutes)?;
    let seed = args.seed.map_or_else(random_seed, Ok)?;
    let stop = stop_on_signal()?;
    let rights = Rights::probe();
    println!("seed {seed}");
    let (start, mut total, mut rounds) = (Instant::now(), Outcome::default(), 0);
    for number in args.round.map_or(0..u64::MAX, |round| round..round + 1) {
        let is_over = start.elapsed() >= time || args.faults.is_some_and(|faults| total.faults.len() >= faults);
        if (is_over && args.round.is_none()) || stop.load(Ordering::Relaxed) {
            break;
        }
        let plan = Plan::new(seed, number);
        if !rights.permit_round(&plan) {
            *total.left_out.entry("round with a /dev/shm of its own".to_owned()).or_default() += 1;
            continue;
        }
        rounds += 1;
        let outcome = in_own_process(seed, number, &plan, &stop)?;
        println!(
            "round {number}: {} x {} of {}, {} faults, {} batches, {} failures",
            plan.shape.groups,
            plan.shape.pool.num_envs,
            plan.shape.pool.id,
            outcome.faults.len(),
            outcome.batches,
            outcome.failures.len()
        );
        for Failure { kind, fault, text } in &outcome.failures {
            println!("    FAILED: {kind} after: {fault}: {text}");
        }
        if !outcome.failures.is_empty() {
            println!("    {plan:?}");
            println!("    again: cargo xtask faults --seed {seed} --round {number}");
        }
        total.add(outcome);
    }
    total.print();
    if rounds == 0 {
        return Err("no round was played".to_owned());
    }
    if total.failures.is_empty() { Ok(()) } else { Err(format!("{} failures; seed {seed}", total.failures.len())) }
}

/// Plays a round and prints its outcome.
pub fn round(seed: u64, number: u64) -> Result<(), String> {
    let outcome = round::play(&Plan::new(seed, number), Rights::probe())?;
    println!("{}", serde_json::to_string(&outcome).map_err(|error| error.to_string())?);
    Ok(())
}

/// A namespace that no other run uses.
pub fn new_namespace() -> Result<Namespace, String> {
    Ok(Namespace::at(format!("/tmp/faults-{:016x}", random_seed()?)))
}

/// Plays a round in a new process, so that it can have a separate /dev/shm and its processes can be found and ended.
fn in_own_process(seed: u64, number: u64, plan: &Plan, stop: &AtomicBool) -> Result<Outcome, String> {
    let namespace = new_namespace()?;
    let mut command = Command::new(actors::own_program()?);
    command.args(["round", &seed.to_string(), &number.to_string()]);
    let mut command = match plan.own_memory {
        Some(megabytes) => actors::with_own_memory(&command, megabytes),
        None => command,
    };
    command.env(ROOT_VARIABLE, namespace.root()).stdin(Stdio::null()).stdout(Stdio::piped());
    let child = command.spawn().map_err(|error| format!("{command:?}: {error}"))?;
    let (id, start) = (child.id(), Instant::now());
    let reader = std::thread::spawn(move || child.wait_with_output());
    while !reader.is_finished() {
        if start.elapsed() >= ROUND_LIMIT || stop.load(Ordering::Relaxed) {
            kill(id);
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    let output = reader.join().map_err(|_| "a thread panicked")?.map_err(|error| error.to_string())?;
    cleanliness::processes(&namespace).into_iter().for_each(kill);
    cleanliness::remove_all(&namespace);
    let outcome = serde_json::from_slice(&output.stdout);
    if stop.load(Ordering::Relaxed) {
        return Ok(outcome.unwrap_or_default());
    }
    outcome.map_err(|_| {
        let status = output.status;
        format!("a round did not end regularly, {status}; again: cargo xtask faults --seed {seed} --round {number}")
    })
}

fn kill(process: u32) {
    actors::signal(process, Signal::KILL);
}

/// A flag that Ctrl-C and SIGTERM set.
pub fn stop_on_signal() -> Result<Arc<AtomicBool>, String> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    ctrlc::set_handler(move || flag.store(true, Ordering::Relaxed)).map_err(|error| error.to_string())?;
    Ok(stop)
}

/// The time that `--minutes` gives.
pub fn duration(minutes: f64) -> Result<Duration, String> {
    let time = Duration::try_from_secs_f64(minutes * 60.0).ok().filter(|time| !time.is_zero());
    time.ok_or_else(|| format!("--minutes must be finite and positive, got {minutes}"))
}

/// A seed from the operating system.
pub fn random_seed() -> Result<u64, String> {
    entropy().map(|bits| bits as u64).map_err(|error| error.to_string())
}
