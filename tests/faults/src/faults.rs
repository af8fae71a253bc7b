//! Executes each kind of fault.

use std::fs::{self, File};
use std::io::Write;
use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::actors::{self, Actor, is_crash};
use crate::cleanliness;
use crate::event::now;
use crate::others::Habit;
use crate::plan::{Fault, Role};
use crate::scene::{LIMIT, Scene};

/// How long a regular end may take.
const END: Duration = LIMIT;

/// How long a process with few descriptors may take to play or to end.
const FEW_DESCRIPTORS: Duration = LIMIT;

const BALLAST: &str = "/dev/shm/ballast";

impl Scene<'_> {
    /// Executes a fault. Returns the time at which it was over; after it, batches must arrive again.
    pub fn apply(&mut self, fault: Fault) -> Result<Duration, String> {
        let milliseconds = Duration::from_millis;
        match fault {
            Fault::Kill { role, down } => {
                self.kill(role);
                self.watch(milliseconds(down))?;
                self.start(role)?;
            }
            Fault::KillStarting { role, moment } => {
                self.replace(role)?;
                std::thread::sleep(Duration::from_micros(moment));
                self.replace(role)?;
            }
            Fault::KillEnding { role, moment } => {
                if let Some(mut actor) = self.take(role) {
                    actor.close_input();
                    std::thread::sleep(Duration::from_micros(moment));
                    actor.kill();
                }
                self.start(role)?;
            }
            Fault::Stop { role, time } => self.stop(role, milliseconds(time))?,
            Fault::StopStarting { role, moment, time } => {
                self.visitor(20)?;
                self.replace(role)?;
                std::thread::sleep(Duration::from_micros(moment));
                self.stop(role, milliseconds(time))?;
            }
            Fault::Restart { down } => {
                self.end(Role::Engine, |engine| engine.signal(Signal::TERM))?;
                self.watch(milliseconds(down))?;
                self.start(Role::Engine)?;
            }
            Fault::Fork { is_killed } => return self.fork(is_killed),
            Fault::Descriptors { role, limit } => self.few_descriptors(role, limit)?,
            Fault::ClockJump { seconds } => {
                cleanliness::set_age(&self.namespace, seconds);
                self.visitor(5)?;
                self.watch(milliseconds(200))?;
                self.replace(Role::Trainer)?;
            }
            Fault::RemoveRoot { then } => {
                let _ = fs::remove_dir_all(self.namespace.root());
                self.removed = Some(now());
                self.visitor(3)?;
                self.watch(milliseconds(400))?;
                self.replace(then)?;
            }
            Fault::FillMemory { role, time } => {
                fill();
                self.filled = Some(now());
                self.replace(role)?;
                self.watch(milliseconds(time))?;
                let _ = fs::remove_file(BALLAST);
            }
            Fault::HoardingObserver => {
                let seed = self.plan.trainer_seed;
                let hoarder = self.spawn(actors::role("observe", &Habit { seed, holds: 100, pause: 0 })?)?;
                self.others.push(hoarder);
                self.watch(milliseconds(1000))?;
            }
            Fault::OtherContainer => {
                cleanliness::set_age(&self.namespace, -60);
                let visit = actors::role("visit", &(self.plan.trainer_seed, 3))?;
                let visitor = self.spawn(actors::with_own_root(&visit))?;
                self.wait_for(visitor)?;
                self.replace(Role::Trainer)?;
            }
            Fault::OtherUser => {
                let intruder = self.spawn(actors::as_nobody(&actors::role("intrude", &())?))?;
                self.wait_for(intruder)?;
                self.replace(Role::Trainer)?;
            }
            Fault::KillLearner { has_checkpoint, moment, resumed } => {
                self.kill_learner(has_checkpoint, moment, resumed)?;
            }
        }
        Ok(now())
    }

    /// Kills the process of a role and starts its successor.
    fn replace(&mut self, role: Role) -> Result<(), String> {
        self.kill(role);
        self.start(role)
    }

    /// Starts a process that lists engines and tries to connect.
    pub fn visitor(&mut self, times: usize) -> Result<(), String> {
        let visitor = self.spawn(actors::role("visit", &(self.plan.trainer_seed, times))?)?;
        self.others.push(visitor);
        Ok(())
    }

    fn stop(&mut self, role: Role, time: Duration) -> Result<(), String> {
        let Some(actor) = self.place(role) else { return Ok(()) };
        actor.signal(Signal::STOP);
        self.watch(time)?;
        if let Some(actor) = self.place(role) {
            actor.signal(Signal::CONT);
        }
        Ok(())
    }

    /// Ends the process of a role regularly.
    pub fn end(&mut self, role: Role, ask: impl FnOnce(&mut Actor)) -> Result<(), String> {
        let Some(mut actor) = self.take(role) else { return Ok(()) };
        ask(&mut actor);
        match actor.wait(END) {
            Some(status) if status.success() => {}
            Some(status) => {
                let complaint = actor.complaint();
                if is_crash(status) || !self.is_excused(actor.id(), &complaint) {
                    self.fail("unexpected end", format!("{role:?} was asked to end: {status}: {complaint}"));
                }
            }
            None => self.fail("does not end", format!("{role:?} was asked to end, and has not within {END:?}")),
        }
        self.look()
    }

    /// Waits for a process that ends on its own.
    fn wait_for(&mut self, mut actor: Actor) -> Result<(), String> {
        match actor.wait(END) {
            Some(status) if status.success() => {}
            Some(status) => {
                return Err(format!("a process that should end by itself failed: {status}: {}", actor.complaint()));
            }
            None => self.fail("does not end", format!("a visitor has not ended within {END:?}")),
        }
        self.look()
    }

    fn fork(&mut self, is_killed: bool) -> Result<Duration, String> {
        self.forked = None;
        if let Some(trainer) = &mut self.trainer {
            trainer.order("fork");
        }
        let start = Instant::now();
        while self.forked.is_none() && start.elapsed() < LIMIT {
            self.watch(Duration::from_millis(2))?;
        }
        let Some(child) = self.forked.take() else { return Err("the trainer has not forked".to_owned()) };
        if is_killed {
            self.kill(Role::Trainer);
        } else {
            self.end(Role::Trainer, Actor::close_input)?;
        }
        self.start(Role::Trainer)?;
        let over = now();
        // The next trainer must play while the child is still running.
        self.next_batch(over, LIMIT)?;
        actors::signal(child, Signal::KILL);
        Ok(over)
    }

    /// A process with too few descriptors must play or end with an error; it must not run without ever answering.
    fn few_descriptors(&mut self, role: Role, limit: u64) -> Result<(), String> {
        self.kill(role);
        let command = self.command(role)?;
        let mut actor = self.spawn(actors::with_descriptors(&command, limit))?;
        let (start, since) = (Instant::now(), now());
        self.limited.insert(actor.id());
        if role == Role::Trainer {
            self.add_trainer(actor.id());
        }
        let mut has_ended = false;
        if role == Role::Engine {
            let id = actor.id();
            while !has_ended && start.elapsed() < FEW_DESCRIPTORS && !self.has_played(id, since) {
                self.watch(Duration::from_millis(5))?;
                has_ended = actor.ended().is_some();
            }
            if !has_ended && !self.has_played(id, since) {
                self.fail("serves and never answers", format!("engine with {limit} descriptors"));
            }
            self.end_limited(id);
        } else {
            self.watch(Duration::from_millis(600))?;
        }
        if let Some(status) = actor.ended()
            && is_crash(status)
        {
            let complaint = actor.complaint();
            self.fail("crash", format!("{role:?} with {limit} descriptors: {status}: {complaint}"));
        }
        actor.kill();
        self.start(role)
    }
}

/// Fills /dev/shm to the last page.
fn fill() {
    let Ok(mut file) = File::create(BALLAST) else { return };
    for size in [1 << 20, 1 << 12] {
        let bytes = vec![1; size];
        while file.write_all(&bytes).is_ok() {}
    }
}
