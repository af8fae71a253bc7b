//! The trainer: a process that plays randomly, compares every batch with its twins', and continues after every error.

use std::collections::VecDeque;
use std::io::BufRead;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use endless_gym_core::pool::{PoolError, ResetOptions};
use endless_gym_core::random::Generator;
use endless_gym_service::{BatchLease, ConnectConfig, GroupReconnection, LastRequest, ServiceError, Trainer};
use nix::unistd::ForkResult;
use rustix::process::{Signal, getpid, kill_process};
use serde::{Deserialize, Serialize};

use crate::checker::{Request, Twin, checksum};
use crate::event::{Event, now};
use crate::others::check_unchanged;
use crate::shape::{SERVICE, Shape};

/// How long a call waits.
const PATIENCE: Duration = Duration::from_millis(400);

/// The argument of the role.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Work {
    pub shape: Shape,
    pub seed: u64,
    /// Whether resets change the reset parameters.
    pub with_options: bool,
    /// Mean time between a batch and the next request, in microseconds.
    pub think: i64,
}

/// The round's orders to its trainer, from standard input.
#[derive(Clone, Default)]
struct Orders {
    stop: Arc<AtomicBool>,
    fork: Arc<AtomicBool>,
}

impl Orders {
    fn read() -> Self {
        let orders = Orders::default();
        let reader = orders.clone();
        std::thread::spawn(move || {
            for line in std::io::stdin().lock().lines() {
                if line.is_ok_and(|line| line == "fork") {
                    reader.fork.store(true, Ordering::Relaxed);
                }
            }
            reader.stop.store(true, Ordering::Relaxed);
        });
        orders
    }

    fn must_stop(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

/// Plays until standard input ends.
pub fn run(work: &Work) -> Result<(), String> {
    let orders = Orders::read();
    let mut draws = Generator::from_seed(work.seed);
    let mut last: Option<(Trainer, Vec<Group>)> = None;
    while !orders.must_stop() {
        let connected = match last.take() {
            None => connect(),
            Some((trainer, groups)) => reconnect(trainer, &groups),
        };
        let Some(mut connected) = connected else {
            std::thread::sleep(Duration::from_millis(5));
            continue;
        };
        let (incarnation, engine) = (connected.specification().incarnation, connected.specification().engine_pid);
        Event::Connected { incarnation, engine }.report();
        let mut play = Play::new(work, &connected).map_err(|error| error.to_string())?;
        while !orders.must_stop() {
            if orders.fork.swap(false, Ordering::Relaxed) {
                fork();
            }
            match play.exchange(&mut connected, &mut draws) {
                Ok(true) => {}
                Ok(false) => break,
                Err(failed) => {
                    let (during, error) = *failed;
                    Event::error(during, &error, Some(engine)).report();
                    if !matches!(error, ServiceError::TimedOut { .. }) {
                        break;
                    }
                }
            }
            std::thread::sleep(Duration::from_micros(draws.integers(0, 2 * work.think + 1) as u64));
        }
        last = Some((connected, play.groups));
    }
    drop(last);
    Event::End.report();
    Ok(())
}

fn connect() -> Option<Trainer> {
    let config = ConnectConfig::new(SERVICE).timeout(PATIENCE);
    Event::Connecting { at: now() }.report();
    Trainer::connect(&config).inspect_err(|error| Event::error("connect", error, None).report()).ok()
}

/// Reconnects, and checks the reported fate of the last requests. A trainer that cannot reconnect connects anew.
fn reconnect(mut trainer: Trainer, groups: &[Group]) -> Option<Trainer> {
    for _ in 0..3 {
        Event::Connecting { at: now() }.report();
        match trainer.reconnect(PATIENCE) {
            Ok(found) => {
                for (index, (group, found)) in groups.iter().zip(&found.groups).enumerate() {
                    check_fate(index, group, found);
                }
                return Some(trainer);
            }
            Err(error) => Event::error("reconnect", &error, None).report(),
        }
    }
    None
}

/// A lost engine must have returned the batches that the trainer received, plus one if it is reported to have played
/// the last request.
fn check_fate(index: usize, group: &Group, found: &GroupReconnection) {
    let (Some(step), Some(lost)) = (group.step, found.lost_step) else { return };
    let is_pending = group.pending.is_some();
    let played = match found.last_request {
        LastRequest::Unknown if is_pending => 0..=1,
        LastRequest::Played if is_pending => 1..=1,
        _ => 0..=0,
    };
    if !played.contains(&lost.saturating_sub(step)) || lost < step {
        let what = format!(
            "group {index}: batch {step} was received, pending: {is_pending}; the lost engine returned {lost}, and its last request is {:?}",
            found.last_request
        );
        Event::Miscounted { what }.report();
    }
}

/// One connection's groups.
struct Play<'a> {
    work: &'a Work,
    groups: Vec<Group>,
    incarnation: u64,
    held: VecDeque<(BatchLease, u32)>,
}

struct Group {
    twin: Twin,
    pending: Option<Request>,
    was_reset: bool,
    /// The number of the last batch.
    step: Option<u64>,
}

/// The call that failed, and why.
type Failed = Box<(&'static str, ServiceError)>;

fn failed(during: &'static str) -> impl Fn(ServiceError) -> Failed {
    move |error| Box::new((during, error))
}

impl<'a> Play<'a> {
    fn new(work: &'a Work, trainer: &Trainer) -> Result<Self, PoolError> {
        let twins = (0..work.shape.groups).map(|group| Twin::new(&work.shape, group));
        let groups =
            twins.map(|twin| Ok::<_, PoolError>(Group { twin: twin?, pending: None, was_reset: false, step: None }));
        let groups: Vec<_> = groups.collect::<Result<_, _>>()?;
        let specification = trainer.specification();
        if let Some(what) = groups.first().and_then(|group| group.twin.difference(&work.shape, specification)) {
            Event::Wrong { what }.report();
        }
        Ok(Play { work, groups, incarnation: specification.incarnation, held: VecDeque::new() })
    }

    /// Sends a request to the groups without a pending answer, and receives one batch. Returns false if the engine was
    /// restarted.
    fn exchange(&mut self, trainer: &mut Trainer, draws: &mut Generator) -> Result<bool, Failed> {
        let (shape, space) = (&self.work.shape, trainer.specification().action_space.clone());
        for (index, group) in self.groups.iter_mut().enumerate().filter(|(_, group)| group.pending.is_none()) {
            if group.was_reset && draws.integers(0, 60) == 0 {
                snapshot(&mut group.twin, trainer, index, draws.integers(0, shape.pool.num_envs as i64) as usize)?;
            }
            let request = if group.was_reset {
                Request::random(draws, shape, &space, self.work.with_options)
            } else {
                // An earlier trainer may have changed the options.
                let options = match &shape.pool.options {
                    ResetOptions::Shared(options) if self.work.with_options => Some(options.clone()),
                    _ => None,
                };
                Request::Seed { seed: self.work.seed, options }
            };
            request.send(trainer, index).map_err(failed("send"))?;
            group.pending = Some(request);
        }
        if draws.integers(0, 200) == 0 {
            let found = trainer.reconnect(PATIENCE).map_err(failed("reconnect"))?;
            if found.restarted {
                // The engine has just been replaced, and the new one knows none of these requests.
                for (index, (group, found)) in self.groups.iter_mut().zip(&found.groups).enumerate() {
                    check_fate(index, group, found);
                    (group.step, group.pending) = (None, None);
                }
                return Ok(false);
            }
            for (index, group) in found.groups.iter().enumerate() {
                // All groups wait for an answer.
                if group.last_request != LastRequest::Pending {
                    let what = format!("group {index}: a pending request is {:?} to reconnect()", group.last_request);
                    Event::Broken { what }.report();
                }
            }
        }
        let lease = trainer.receive_any(PATIENCE).map_err(failed("receive"))?;
        self.check(&lease, trainer)?;
        self.hold(lease, draws);
        Ok(true)
    }

    fn check(&mut self, lease: &BatchLease, trainer: &mut Trainer) -> Result<(), Failed> {
        let (index, step) = (lease.group(), lease.step());
        let Some(group) = self.groups.get_mut(index) else {
            Event::Wrong { what: format!("a batch of group {index}, which does not exist") }.report();
            return Ok(());
        };
        let Some(request) = group.pending.take() else {
            Event::Miscounted { what: format!("group {index}: batch {step} answers no request") }.report();
            return Ok(());
        };
        if let Some(last) = group.step.filter(|last| last + 1 != step) {
            Event::Miscounted { what: format!("group {index}: batch {step} after batch {last}") }.report();
        }
        group.step = Some(step);
        let compared = if !group.was_reset && step > 1 {
            self.held.clear();
            let take = |env| retry(|| trainer.snapshot(index, env, PATIENCE));
            group.twin.adopt(&request, lease, take).map_err(failed("snapshot"))?
        } else {
            group.twin.compare(&request, lease)
        };
        group.was_reset = true;
        match &compared {
            Ok(None) => {}
            Ok(Some(difference)) => {
                Event::Wrong { what: format!("group {index}, batch {step}, {request:?}: {difference}") }.report();
                group.was_reset = false;
            }
            Err(error) => Event::Wrong { what: format!("the twin refuses what the engine played: {error}") }.report(),
        }
        let (incarnation, checksum, is_correct) = (self.incarnation, checksum(lease), matches!(compared, Ok(None)));
        Event::Batch { at: now(), incarnation, group: index, step, checksum, is_correct }.report();
        Ok(())
    }

    /// Holds some batches for a while, in which they must not change.
    fn hold(&mut self, lease: BatchLease, draws: &mut Generator) {
        if draws.integers(0, 4) == 0 {
            let sum = checksum(&lease);
            self.held.push_back((lease, sum));
        }
        // An engine allows three held batches of a group, including the next one.
        while self.held.len() > draws.integers(0, 3) as usize {
            self.held.pop_front().into_iter().for_each(check_unchanged);
        }
    }
}

/// Takes a snapshot of an environment, restores it, and compares it with the twin's.
fn snapshot(twin: &mut Twin, trainer: &mut Trainer, group: usize, env: usize) -> Result<(), Failed> {
    let taken = retry(|| trainer.snapshot(group, env, PATIENCE)).map_err(failed("snapshot"))?;
    retry(|| trainer.restore(group, env, &taken, PATIENCE)).map_err(failed("restore"))?;
    match twin.snapshot(env, &taken) {
        Ok(true) => {}
        found => Event::Wrong { what: format!("group {group}: the snapshot of environment {env} differs: {found:?}") }
            .report(),
    }
    Ok(())
}

/// Repeats a call that can continue after a time-out, since a stopped engine is continued eventually.
fn retry<T>(mut call: impl FnMut() -> Result<T, ServiceError>) -> Result<T, ServiceError> {
    loop {
        match call() {
            Err(ServiceError::TimedOut { .. }) => {}
            other => return other,
        }
    }
}

/// Forks a child as a data loader would: it keeps all descriptors and memory, and does not exec another program.
fn fork() {
    // SAFETY: the child only makes system calls, which are async-signal-safe.
    match unsafe { nix::unistd::fork() } {
        Ok(ForkResult::Child) => loop {
            std::thread::sleep(Duration::from_secs(120));
            let _ = kill_process(getpid(), Signal::KILL);
        },
        Ok(ForkResult::Parent { child }) => Event::Forked { child: child.as_raw().unsigned_abs() }.report(),
        Err(error) => panic!("cannot fork: {error}"),
    }
}
