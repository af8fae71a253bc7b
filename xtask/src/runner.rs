//! Runs stages side by side, each with its output in a file of its own.

use std::fs::File;
use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal};

use crate::stages::Stage;
use crate::venv::target;

/// Stages at a time: the tests use several threads and processes themselves, and some have time limits.
const SIDE_BY_SIDE: usize = 2;

/// How long stages may clean up after an interrupt.
const GRACE: Duration = Duration::from_secs(10);

/// How a stage ended.
pub struct Outcome {
    pub stage: &'static Stage,
    pub duration: Duration,
    /// What it printed; empty if it did not run.
    pub output: String,
    pub log: PathBuf,
    pub result: Result<(), String>,
}

struct Running {
    index: usize,
    group: Pid,
    start: Instant,
    log: PathBuf,
}

enum Event {
    Ended(usize, io::Result<ExitStatus>),
    Interrupted,
}

/// Runs all stages, at most one that compiles at a time, and each after those that it names. A failure does not end the others. What
/// cargo keeps to compile `incremental`ly takes gigabytes and pays where sources change between runs.
///
/// # Errors
///
/// If a stage cannot be started, or after an interrupt, which ends all stages.
pub fn run(stages: &[&'static Stage], incremental: bool) -> Result<Vec<Outcome>, String> {
    let logs = target()?.join("test-logs");
    std::fs::create_dir_all(&logs).map_err(|error| format!("{}: {error}", logs.display()))?;
    let (sender, events) = mpsc::channel();
    let interrupt = sender.clone();
    let handler = ctrlc::set_handler(move || drop(interrupt.send(Event::Interrupted)));
    handler.map_err(|error| format!("signals cannot be handled: {error}"))?;

    let mut waiting: Vec<&'static Stage> = stages.to_vec();
    let mut running: Vec<Running> = Vec::new();
    let mut outcomes: Vec<Outcome> = Vec::new();
    loop {
        while running.len() < SIDE_BY_SIDE {
            let compiling = running.iter().any(|other| stages[other.index].compiles);
            let is_done = |name: &str| {
                let done = |outcome: &Outcome| outcome.stage.name == name;
                outcomes.iter().any(done) || stages.iter().all(|stage| stage.name != name)
            };
            let ready = |stage: &&Stage| !(stage.compiles && compiling) && stage.after.iter().all(|name| is_done(name));
            let Some(position) = waiting.iter().position(ready) else { break };
            let stage = waiting.remove(position);
            let log = logs.join(format!("{}.log", stage.name.replace(' ', "-")));
            let failed = outcomes.iter().find(|done| done.result.is_err() && stage.after.contains(&done.stage.name));
            if let Some(failed) = failed {
                let result = Err(format!("not run, since `{}` failed", failed.stage.name));
                outcomes.push(Outcome { stage, duration: Duration::ZERO, output: String::new(), log, result });
                continue;
            }
            println!("==> {}", stage.name);
            let index = stages.iter().position(|other| other.name == stage.name).unwrap_or_default();
            match start(index, stage, log, incremental, &sender) {
                Ok(stage) => running.push(stage),
                Err(message) => {
                    end(&running, &events);
                    return Err(message);
                }
            }
        }
        if running.is_empty() {
            return Ok(outcomes);
        }
        match events.recv() {
            Ok(Event::Ended(index, status)) => {
                let Some(position) = running.iter().position(|stage| stage.index == index) else { continue };
                let outcome = ended(stages[index], running.remove(position), status);
                report(&outcome);
                outcomes.push(outcome);
            }
            Ok(Event::Interrupted) | Err(_) => {
                end(&running, &events);
                return Err("interrupted".to_owned());
            }
        }
    }
}

/// Starts `cargo xtask stage NAME` in a process group of its own.
fn start(
    index: usize,
    stage: &Stage,
    log: PathBuf,
    incremental: bool,
    sender: &Sender<Event>,
) -> Result<Running, String> {
    let output = File::create(&log).and_then(|file| Ok((file.try_clone()?, file)));
    let (output, errors) = output.map_err(|error| format!("{}: {error}", log.display()))?;
    // A stage may rebuild this program: then its path names another file or, for a moment, none.
    let mut command = Command::new("/proc/self/exe");
    command.args(["stage", stage.name]).process_group(0).stdin(Stdio::null()).stdout(output).stderr(errors);
    if !incremental {
        command.env("CARGO_INCREMENTAL", "0");
    }
    let mut child = command.spawn().map_err(|error| format!("`{}` cannot be started: {error}", stage.name))?;
    let group = Pid::from_child(&child);
    let sender = sender.clone();
    std::thread::spawn(move || drop(sender.send(Event::Ended(index, child.wait()))));
    Ok(Running { index, group, start: Instant::now(), log })
}

fn ended(stage: &'static Stage, running: Running, status: io::Result<ExitStatus>) -> Outcome {
    let output = std::fs::read(&running.log).unwrap_or_default();
    let result = match status {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(status.to_string()),
        Err(error) => Err(error.to_string()),
    };
    let output = String::from_utf8_lossy(&output).into_owned();
    Outcome { stage, duration: running.start.elapsed(), output, log: running.log, result }
}

/// Prints the result of a stage, and all that it printed if it failed.
fn report(outcome: &Outcome) {
    let (name, seconds) = (outcome.stage.name, outcome.duration.as_secs_f64());
    match &outcome.result {
        Ok(()) => println!("    {name}: {seconds:.1} s"),
        Err(message) => {
            println!("    {name}: FAILED after {seconds:.1} s: {message}; its output ({}):", show(&outcome.log));
            println!("{}", outcome.output.trim_end());
        }
    }
}

/// A path below the working directory as a relative one.
pub fn show(path: &Path) -> String {
    let relative = std::env::current_dir().ok().and_then(|folder| path.strip_prefix(folder).ok());
    relative.unwrap_or(path).display().to_string()
}

/// Interrupts all processes of the stages, and kills them if they do not end in time or at a second interrupt.
fn end(running: &[Running], events: &mpsc::Receiver<Event>) {
    let signal = |signal| {
        for stage in running {
            // Without an effect if the group has ended.
            let _ = rustix::process::kill_process_group(stage.group, signal);
        }
    };
    signal(Signal::INT);
    let limit = Instant::now() + GRACE;
    let mut left = running.len();
    while left > 0 {
        match events.recv_timeout(limit.saturating_duration_since(Instant::now())) {
            Ok(Event::Ended(..)) => left -= 1,
            Ok(Event::Interrupted) | Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => break,
        }
    }
    // Also those whose stage has ended and that are left of its group.
    signal(Signal::KILL);
}
