//! A round's processes, and the rules that judge their reports and exits.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::process::{Command, ExitStatus};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use endless_gym_service::{Namespace, ROOT_VARIABLE};
use rustix::process::Signal;

use crate::actors::{self, Actor, is_crash};
use crate::cleanliness;
use crate::event::{Event, now};
use crate::ledger::Ledger;
use crate::others::Habit;
use crate::plan::{Fault, Plan, Role};
use crate::report::{Failure, Outcome};
use crate::trainer::Work;

/// How long the next correct batch, or the end of a process, may take. Far longer than needed, since the machine may be
/// busy: it only tells slow from never.
pub const LIMIT: Duration = Duration::from_secs(60);

/// Maximum number of failures of one kind that a round keeps.
const KEPT: usize = 3;

/// The processes of a round.
pub struct Scene<'a> {
    pub plan: &'a Plan,
    pub namespace: Namespace,
    pub outcome: Outcome,
    /// The fault that is being executed.
    pub current: Option<Fault>,
    /// Processes that are restarted if they end on their own.
    pub engine: Option<Actor>,
    pub trainer: Option<Actor>,
    pub observer: Option<Actor>,
    /// Other processes, which may end at any time.
    pub others: Vec<Actor>,
    /// Processes with few descriptors, whose errors are expected.
    pub limited: HashSet<u32>,
    /// The last forked process.
    pub forked: Option<u32>,
    /// When the namespace's directory was removed.
    pub removed: Option<Duration>,
    /// When /dev/shm was full.
    pub filled: Option<Duration>,
    /// When each process last began to connect, or started.
    attempts: HashMap<u32, Duration>,
    /// Processes whose last attempt to connect succeeded, and the engines that they found.
    connected: HashSet<u32>,
    sender: Sender<(u32, Event)>,
    events: Receiver<(u32, Event)>,
    /// Engines that were ended on purpose.
    ended_engines: HashSet<u32>,
    /// All trainers so far and their numbers, including killed ones, whose reports may still be in their pipes.
    trainers: HashMap<u32, u64>,
    /// The process of each incarnation.
    engines: HashMap<u64, u32>,
    /// Checksums by incarnation, group and step.
    checksums: HashMap<(u64, usize, u64), (bool, u32)>,
    ledger: Ledger,
    /// The last correct batch: its time, its trainer and its engine.
    last_batch: Option<(Duration, u32, u32)>,
    started: u64,
    /// The text of the last error of each kind.
    pub last_errors: HashMap<String, String>,
}

impl<'a> Scene<'a> {
    pub fn new(plan: &'a Plan, namespace: Namespace) -> Self {
        let (sender, events) = channel();
        Scene {
            plan,
            namespace,
            outcome: Outcome::default(),
            current: None,
            engine: None,
            trainer: None,
            observer: None,
            others: Vec::new(),
            limited: HashSet::new(),
            forked: None,
            removed: None,
            filled: None,
            connected: HashSet::new(),
            attempts: HashMap::new(),
            sender,
            events,
            ended_engines: HashSet::new(),
            trainers: HashMap::new(),
            engines: HashMap::new(),
            checksums: HashMap::new(),
            ledger: Ledger::default(),
            last_batch: None,
            started: 0,
            last_errors: HashMap::new(),
        }
    }

    /// Records a failure.
    pub fn fail(&mut self, kind: &str, text: String) {
        let fault = self.current.map_or("no fault".to_owned(), Fault::kind);
        let same = |failure: &&Failure| failure.kind == kind && failure.fault == fault;
        if self.outcome.failures.iter().filter(same).count() < KEPT {
            self.outcome.failures.push(Failure { kind: kind.to_owned(), fault, text });
        }
    }

    /// The command that starts a process in a role.
    pub fn command(&mut self, role: Role) -> Result<Command, String> {
        self.started += 1;
        let seed = self.plan.trainer_seed.wrapping_add(self.started);
        match role {
            Role::Engine => {
                let config = cleanliness::config(&self.namespace);
                let json = serde_json::to_vec(&self.plan.shape.engine(&self.namespace)).map_err(|e| e.to_string())?;
                fs::write(&config, json).map_err(|e| format!("{}: {e}", config.display()))?;
                let mut engine = Command::new(actors::engine_program()?);
                engine.args(["serve", "--child", "--config"]).arg(config);
                Ok(engine)
            }
            Role::Trainer => {
                let shape = self.plan.shape.clone();
                actors::role(
                    "train",
                    &Work { shape, seed, with_options: self.plan.with_options, think: self.plan.think },
                )
            }
            Role::Observer => actors::role("observe", &Habit { seed, holds: (seed % 3) as usize, pause: 20 }),
        }
    }

    /// Starts any process of the round.
    pub fn spawn(&mut self, mut command: Command) -> Result<Actor, String> {
        command.env(ROOT_VARIABLE, self.namespace.root());
        let start = now();
        let actor = Actor::start(command, &self.sender)?;
        self.attempts.insert(actor.id(), start);
        Ok(actor)
    }

    /// Starts the process of a role and replaces the previous one.
    pub fn start(&mut self, role: Role) -> Result<(), String> {
        let command = self.command(role)?;
        let actor = self.spawn(command)?;
        if role == Role::Trainer {
            self.add_trainer(actor.id());
        }
        *self.place(role) = Some(actor);
        Ok(())
    }

    /// The process of a role.
    pub fn place(&mut self, role: Role) -> &mut Option<Actor> {
        match role {
            Role::Engine => &mut self.engine,
            Role::Trainer => &mut self.trainer,
            Role::Observer => &mut self.observer,
        }
    }

    /// Stops watching the process of a role, since it is going to end.
    pub fn take(&mut self, role: Role) -> Option<Actor> {
        let actor = self.place(role).take();
        if let Some(engine) = actor.as_ref().filter(|_| role == Role::Engine) {
            self.ended_engines.insert(engine.id());
        }
        actor
    }

    /// Kills the process of a role.
    pub fn kill(&mut self, role: Role) {
        if let Some(mut actor) = self.take(role) {
            actor.kill();
        }
    }

    /// Watches for a time.
    pub fn watch(&mut self, time: Duration) -> Result<(), String> {
        let start = Instant::now();
        while start.elapsed() < time {
            self.look()?;
            std::thread::sleep(Duration::from_millis(1).min(time.saturating_sub(start.elapsed())));
        }
        Ok(())
    }

    /// Waits for a correct batch after `since`, from the current engine to the current trainer. Returns its time.
    pub fn next_batch(&mut self, since: Duration, limit: Duration) -> Result<Option<Duration>, String> {
        let start = Instant::now();
        loop {
            self.look()?;
            let present = (self.trainer.as_ref().map(Actor::id), self.engine.as_ref().map(Actor::id));
            if let Some((at, trainer, engine)) = self.last_batch
                && at > since
                && present == (Some(trainer), Some(engine))
            {
                return Ok(Some(at));
            }
            if start.elapsed() >= limit {
                return Ok(None);
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Reads reports, and restarts processes that have ended on their own.
    pub fn look(&mut self) -> Result<(), String> {
        while let Ok((process, event)) = self.events.try_recv() {
            self.judge(process, event);
        }
        for role in [Role::Engine, Role::Trainer, Role::Observer] {
            let Some(actor) = self.place(role) else { continue };
            let (Some(status), id) = (actor.ended(), actor.id()) else { continue };
            let complaint = actor.complaint();
            let text = format!("{role:?} {id} ended by itself, {status}: {complaint}");
            if is_crash(status) && !self.lost_memory(id, status) {
                self.fail("crash", text);
            } else if !is_crash(status) && !self.is_excused(id, &complaint) {
                self.fail("unexpected end", text);
            }
            drop(self.take(role));
            // Avoid a tight loop if a process cannot start.
            std::thread::sleep(Duration::from_millis(50));
            self.start(role)?;
        }
        Ok(())
    }

    fn is_short_of_memory(&self) -> bool {
        self.plan.own_memory.is_some()
    }

    /// Whether a process may fail with this message.
    pub fn is_excused(&self, process: u32, complaint: &str) -> bool {
        self.limited.contains(&process)
            || (self.is_short_of_memory() && complaint.contains("/dev/shm"))
            // Many processes take the lock in turn. If it were never free again, the round would not continue.
            || complaint.contains("has been locked")
    }

    /// Whether a process was connecting when the memory was filled. The memory that it found free may then be missing,
    /// and SIGBUS kills it, since iceoryx2 allocates no pages in advance. This must not happen to a connected process.
    fn lost_memory(&self, process: u32, status: ExitStatus) -> bool {
        status.signal() == Some(Signal::BUS.as_raw())
            && !self.connected.contains(&process)
            && self.began_before(process, self.filled)
    }

    /// Whether a process last began to connect before that time. If so, even its late reports may be due to the earlier
    /// event.
    fn began_before(&self, process: u32, time: Option<Duration>) -> bool {
        self.attempts.get(&process).zip(time).is_some_and(|(began, time)| *began <= time)
    }

    fn judge(&mut self, process: u32, event: Event) {
        match event {
            Event::Connecting { at } => {
                self.attempts.insert(process, at);
                self.connected.remove(&process);
            }
            Event::Connected { incarnation, engine } => {
                self.engines.insert(incarnation, engine);
                // An engine that was found already has all its memory.
                self.connected.extend([process, engine]);
            }
            Event::Batch { at, incarnation, group, step, checksum, is_correct } => {
                let trainer = self.trainers.get(&process);
                if let Some(number) = trainer {
                    self.outcome.batches += 1;
                    self.ledger.add(incarnation, group, *number, step);
                }
                if !is_correct {
                    return;
                }
                if trainer.is_some() {
                    self.last_batch = self.engines.get(&incarnation).map(|engine| (at, process, *engine));
                }
                self.compare(trainer.is_some(), (incarnation, group, step), checksum);
            }
            Event::Wrong { what } => self.fail("wrong bytes", what),
            Event::Miscounted { what } => self.fail("lost or doubled step", what),
            Event::Broken { what } => self.fail("broken promise", what),
            Event::Shown { messages } => self.outcome.shown += messages,
            Event::Forked { child } => self.forked = Some(child),
            Event::End => {}
            Event::Error { during, kind, text, engine } => {
                *self.outcome.errors.entry(kind.clone()).or_default() += 1;
                self.last_errors.insert(kind.clone(), text.clone());
                let is_lost = matches!(kind.as_str(), "EngineLost" | "EngineRestarted");
                // An engine whose directory was removed restarts in the same process.
                let is_removed = self.began_before(process, self.removed);
                let has_crashed = self.engine.as_mut().is_some_and(|engine| engine.ended().is_some());
                let is_running = engine.is_some_and(|engine| !self.ended_engines.contains(&engine)) && !has_crashed;
                if is_lost && !is_removed && is_running {
                    let text = format!("{during}: {text}, and engine {} was running", engine.unwrap_or_default());
                    self.fail("false end of an engine", text);
                }
                let expected = match kind.as_str() {
                    "EngineLost" | "EngineRestarted" | "UnknownEngine" | "TrainerExists" | "TimedOut"
                    | "NamespaceLocked" => true,
                    "TooManyObservers" | "TooManyBatchesHeld" | "NoSuchGroup" => during == "observe",
                    // iceoryx2 may fail in a process that joins while the files are removed.
                    "RootRemoved" | "Root" | "Middleware" => is_removed,
                    _ => false,
                };
                if !expected && !self.is_excused(process, &text) {
                    self.fail("unexpected error", format!("{during}: {kind}: {text}"));
                }
            }
        }
    }

    /// Compares a batch that an observer saw with the trainer's, which equals the twin's.
    fn compare(&mut self, is_trainer: bool, batch: (u64, usize, u64), checksum: u32) {
        match self.checksums.insert(batch, (is_trainer, checksum)) {
            Some((_, other)) if other != checksum => {
                let (_, group, step) = batch;
                self.fail(
                    "wrong bytes",
                    format!("group {group}: an observer's batch {step} differs from the trainer's"),
                );
            }
            Some((before, _)) if before != is_trainer => self.outcome.observed += 1,
            _ => {}
        }
        if self.checksums.len() > 50_000 {
            self.checksums.clear();
        }
    }

    /// Reads the remaining reports of ended processes, and checks what requires all reports.
    pub fn close(&mut self) {
        // The threads that read the pipes hold the other senders.
        drop(std::mem::replace(&mut self.sender, channel().0));
        loop {
            match self.events.recv_timeout(LIMIT) {
                Ok((process, event)) => self.judge(process, event),
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {
                    self.fail("left behind", "a process holds a pipe of one that has ended".to_owned());
                    break;
                }
            }
        }
        for fault in self.ledger.faults() {
            self.fail("lost or doubled step", fault);
        }
    }

    /// Whether the trainer has received a correct batch from that engine since then.
    pub fn has_played(&self, engine: u32, since: Duration) -> bool {
        self.last_batch.is_some_and(|(at, _, from)| at > since && from == engine)
    }

    /// Records that a process is a trainer.
    pub fn add_trainer(&mut self, process: u32) {
        self.trainers.insert(process, self.trainers.len() as u64);
    }

    /// Records that an engine is going to be ended on purpose.
    pub fn end_limited(&mut self, engine: u32) {
        self.ended_engines.insert(engine);
    }
}
