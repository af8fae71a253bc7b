//! A long run without faults: plays all ids with random options and formats while observers and a page watch, and
//! measures memory, descriptors and files.

use std::fs;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use endless_gym::environments;
use endless_gym_core::random::Generator;
use endless_gym_service::Namespace;
use rustix::process::Signal;

use crate::actors::{self, Actor};
use crate::cleanliness;
use crate::event::now;
use crate::plan::{Plan, Role};
use crate::report::Outcome;
use crate::round;
use crate::run::{duration, new_namespace, random_seed, stop_on_signal};
use crate::scene::{LIMIT, Scene};
use crate::shape::Shape;

/// Growth that is not a leak, since pictures for other options take different amounts of memory.
const MEMORY: u64 = 16 << 20;
/// Pictures of one environment's options at all levels of darkness, which Searing Spotlights makes on first use. The
/// test `replaced_options_leave_no_memory_behind` shows that they are freed.
const DARK_PICTURES: u64 = 28 << 20;
const DESCRIPTORS: u64 = 4;
/// For a process that only starts others.
const OWN_MEMORY: u64 = 2 << 20;
const SEGMENTS: u64 = 8;

/// Arguments of `soak`.
#[derive(clap::Args)]
pub struct Args {
    /// Duration of the run; each id gets the same share of it.
    #[arg(long, default_value_t = 60.0)]
    minutes: f64,
    /// Start and stop this many engines and trainers instead, in every way.
    #[arg(long)]
    starts: Option<u64>,
    /// The seed of options, formats and actions [default: random].
    #[arg(long)]
    seed: Option<u64>,
}

/// What is counted, and the growth of it that is not a leak; that of memory depends on the environments.
const COUNTERS: [(&str, Option<u64>); 8] = [
    ("memory of the engine", None),
    ("memory of the trainer", None),
    ("memory of the page's server", None),
    ("descriptors of the engine", Some(DESCRIPTORS)),
    ("descriptors of the trainer", Some(DESCRIPTORS)),
    ("descriptors of the page's server", Some(DESCRIPTORS)),
    ("segments", Some(SEGMENTS)),
    ("files", Some(SEGMENTS)),
];

/// The counters at one time.
type Usage = [u64; COUNTERS.len()];

fn usage(scene: &Scene<'_>, page: u32) -> Usage {
    let id = |actor: &Option<Actor>| actor.as_ref().map_or(0, Actor::id);
    let processes = [id(&scene.engine), id(&scene.trainer), page];
    let ([engine, trainer, server], [of_engine, of_trainer, of_server]) =
        (processes.map(memory), processes.map(descriptors));
    let files = cleanliness::files(&scene.namespace);
    let segments = files.iter().filter(|path| path.starts_with("/dev/shm")).count();
    let files = files.len() - segments;
    [engine, trainer, server, of_engine, of_trainer, of_server, segments as u64, files as u64]
}

/// The counters that have grown during a phase: the lowest value of the last third exceeds the highest of the first by more
/// than the limit, which is `memory` bytes for memory. The first two fifths of the phase, in which the environments make
/// pictures of their options, are skipped.
fn growth(usages: &[Usage], memory: u64) -> Vec<String> {
    let usages = &usages[2 * usages.len() / 5..];
    let third = usages.len() / 3;
    let grown = COUNTERS.iter().enumerate().filter_map(|(counter, (name, limit))| {
        let before = usages[..third].iter().map(|usage| usage[counter]).max()?;
        let after = usages[usages.len() - third..].iter().map(|usage| usage[counter]).min()?;
        let limit = limit.unwrap_or(memory);
        (after > before + limit).then(|| format!("{name} from at most {before} to at least {after}"))
    });
    grown.collect()
}

/// Resident memory of a process in bytes.
fn memory(process: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok()).map_or(0, |kilobytes| kilobytes << 10)
}

fn descriptors(process: u32) -> u64 {
    fs::read_dir(format!("/proc/{process}/fd")).map_or(0, |entries| entries.count() as u64)
}

/// Runs `soak`.
pub fn run(args: &Args) -> Result<(), String> {
    let time = duration(args.minutes)?;
    let seed = args.seed.map_or_else(random_seed, Ok)?;
    let stop = stop_on_signal()?;
    println!("seed {seed}");
    if let Some(count) = args.starts {
        return starts(count, seed, &stop);
    }
    let ids: Vec<&str> = environments().specs().map(|spec| spec.id).collect();
    let mut draws = Generator::from_seed(seed);
    let start = Instant::now();
    let (mut total, mut steps) = (Outcome::default(), 0);
    for (number, id) in ids.iter().enumerate() {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        let end = time.mul_f64((number + 1) as f64 / ids.len() as f64);
        let plan = calm(Shape::random_of(&mut draws, id, 16), &mut draws, true);
        let namespace = new_namespace()?;
        let must_end = || start.elapsed() >= end || stop.load(Ordering::Relaxed);
        let outcome = phase(&plan, namespace.clone(), &mut draws, start, must_end);
        cleanliness::remove_all(&namespace);
        let outcome = outcome?;
        println!("{id}: {} steps, {} failures", self::steps(&outcome, &plan), outcome.failures.len());
        for failure in &outcome.failures {
            println!("    FAILED: {}: {}\n    {:?}", failure.kind, failure.text, plan.shape);
        }
        steps += self::steps(&outcome, &plan);
        total.add(outcome);
    }
    println!(
        "{steps} steps compared in {:.1} minutes, {} messages shown",
        start.elapsed().as_secs_f64() / 60.0,
        total.shown
    );
    end(&total, seed)
}

/// A plan without faults, and without the observers and visitors of a round.
fn calm(shape: Shape, draws: &mut Generator, with_options: bool) -> Plan {
    Plan {
        shape,
        trainer_seed: draws.integers(0, 1 << 40) as u64,
        with_options,
        think: 0,
        observers: 0,
        visitors: 0,
        own_memory: None,
        steps: Vec::new(),
    }
}

/// Prints the sums of a run. Failures are its error.
fn end(total: &Outcome, seed: u64) -> Result<(), String> {
    let failures = total.failures.len();
    println!("{} batches of trainers and {} of observers compared, {failures} failures", total.batches, total.observed);
    if failures == 0 { Ok(()) } else { Err(format!("{failures} failures; seed {seed}")) }
}

/// Starts and stops engines and trainers in one namespace. Nothing of them may be left, and this process must not grow.
fn starts(count: u64, seed: u64, stop: &AtomicBool) -> Result<(), String> {
    let (start, mut draws, namespace) = (Instant::now(), Generator::from_seed(seed), new_namespace()?);
    let (mut total, mut usages) = (Outcome::default(), Vec::new());
    for number in 1..=count {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        let plan = calm(Shape::random(&mut draws, 4), &mut draws, false);
        let mut scene = Scene::new(&plan, namespace.clone());
        scene.start(Role::Engine)?;
        scene.start(Role::Trainer)?;
        if scene.next_batch(now(), LIMIT)?.is_none() {
            scene.fail("no batches", format!("the trainer has not played within {LIMIT:?}"));
        }
        match draws.integers(0, 6) {
            0 => scene.end(Role::Engine, |engine| engine.signal(Signal::TERM))?,
            1 => scene.end(Role::Engine, |engine| engine.signal(Signal::INT))?,
            2 => scene.kill(Role::Engine),
            3 => scene.kill(Role::Trainer),
            4 => scene.end(Role::Trainer, Actor::close_input)?,
            _ => scene.end(Role::Engine, Actor::close_input)?,
        }
        round::end(&mut scene)?;
        for failure in &scene.outcome.failures {
            println!("start {number}: FAILED: {}: {}\n    {:?}", failure.kind, failure.text, plan.shape);
        }
        total.add(scene.outcome);
        let own = std::process::id();
        let (memory, descriptors) = (memory(own), descriptors(own));
        usages.push((memory, descriptors));
        if number.is_multiple_of(100) || number == count {
            let (failures, seconds) = (total.failures.len(), start.elapsed().as_secs());
            println!(
                "{number} starts in {seconds} s, {failures} failures, own memory {memory}, {descriptors} descriptors"
            );
        }
    }
    cleanliness::remove_all(&namespace);
    // The allocator's arenas grow during the first starts.
    let (Some(before), Some(after)) = (usages.get(usages.len() / 10), usages.last()) else {
        return Err("no engine was started".to_owned());
    };
    if after.0 > before.0 + OWN_MEMORY || after.1 > before.1 {
        return Err(format!("memory and descriptors have grown from {before:?} to {after:?}; seed {seed}"));
    }
    end(&total, seed)
}

fn phase(
    plan: &Plan,
    namespace: Namespace,
    draws: &mut Generator,
    start: Instant,
    must_end: impl Fn() -> bool,
) -> Result<Outcome, String> {
    let mut scene = Scene::new(plan, namespace);
    for role in [Role::Engine, Role::Trainer, Role::Observer] {
        scene.start(role)?;
    }
    scene.visitor(usize::MAX)?;
    let page = scene.spawn(actors::role("show", &())?)?;
    let page_id = page.id();
    scene.others.push(page);
    let mut usages = Vec::new();
    let mut minute = start.elapsed().as_secs() / 60;
    let mut next_observer = Instant::now();
    while !must_end() {
        scene.watch(Duration::from_millis(500))?;
        usages.push(usage(&scene, page_id));
        if Instant::now() >= next_observer {
            // Observers end regularly or are killed.
            if draws.integers(0, 2) == 0 {
                scene.kill(Role::Observer);
            } else {
                scene.end(Role::Observer, Actor::close_input)?;
            }
            scene.start(Role::Observer)?;
            next_observer = Instant::now() + Duration::from_millis(draws.integers(500, 8000) as u64);
        }
        if start.elapsed().as_secs() / 60 > minute {
            minute += 1;
            let failures = scene.outcome.failures.len();
            println!(
                "minute {minute}: {}: {} steps, {failures} failures",
                plan.shape.pool.id,
                steps(&scene.outcome, plan)
            );
            println!(
                "    {:?}",
                COUNTERS.iter().map(|(name, _)| name).zip(usages.last().into_iter().flatten()).collect::<Vec<_>>()
            );
        }
    }
    // A very short run is not judged, since its processes are still starting.
    if usages.len() >= 30 {
        let shape = &plan.shape;
        let dark = if shape.pool.id.contains("SearingSpotlights") { DARK_PICTURES } else { 0 };
        let memory = MEMORY + dark * (shape.groups * shape.pool.num_envs) as u64;
        for grown in growth(&usages, memory) {
            scene.fail("growth", grown);
        }
    }
    let ended: Vec<_> = scene.others.iter_mut().filter_map(|other| Some((other.ended()?, other.complaint()))).collect();
    for (status, complaint) in ended {
        scene.fail("unexpected end", format!("a visitor or the page: {status}: {complaint}"));
    }
    round::end(&mut scene)?;
    if scene.outcome.batches == 0 {
        scene.fail("no batches", "the trainer has not played".to_owned());
    }
    if scene.outcome.shown == 0 {
        scene.fail("no messages", "the page has shown nothing".to_owned());
    }
    Ok(std::mem::take(&mut scene.outcome))
}

fn steps(outcome: &Outcome, plan: &Plan) -> u64 {
    outcome.batches * plan.shape.pool.num_envs as u64
}
