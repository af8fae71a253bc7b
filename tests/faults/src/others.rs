//! The other processes of a round: observers, visitors, and processes of other users.

use std::io::Read;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use endless_gym_core::random::Generator;
use endless_gym_service::{BatchLease, ConnectConfig, Namespace, Observer, ServiceError, Trainer, running_engines};
use serde::{Deserialize, Serialize};

use crate::checker::checksum;
use crate::cleanliness;
use crate::event::{Event, now};
use crate::shape::SERVICE;

const PATIENCE: Duration = Duration::from_millis(400);

/// How an observer behaves.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Habit {
    pub seed: u64,
    /// Number of batches that it holds.
    pub holds: usize,
    /// Longest time between two batches in milliseconds.
    pub pause: i64,
}

pub fn stop_at_end_of_input() -> Arc<AtomicBool> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    std::thread::spawn(move || {
        let _ = std::io::stdin().read_to_end(&mut Vec::new());
        flag.store(true, Ordering::Relaxed);
    });
    stop
}

/// Observes groups in turn until standard input ends.
pub fn observe(habit: &Habit) {
    let stop = stop_at_end_of_input();
    let must_stop = || stop.load(Ordering::Relaxed);
    let mut draws = Generator::from_seed(habit.seed);
    let mut groups = 1;
    while !must_stop() {
        let group = draws.integers(0, groups as i64) as usize;
        let config = ConnectConfig::new(SERVICE).timeout(PATIENCE);
        Event::Connecting { at: now() }.report();
        let mut observer = match Observer::connect(&config, group) {
            Ok(observer) => observer,
            Err(error) => {
                groups = if matches!(error, ServiceError::NoSuchGroup { .. }) { 1 } else { groups };
                Event::error("observe", &error, None).report();
                std::thread::sleep(Duration::from_millis(20));
                continue;
            }
        };
        let (incarnation, engine) = (observer.specification().incarnation, observer.specification().engine_pid);
        groups = observer.specification().groups;
        Event::Connected { incarnation, engine }.report();
        let mut held: Vec<(BatchLease, u32)> = Vec::new();
        let batches = draws.integers(1, 200);
        for _ in 0..batches {
            let received = if must_stop() { break } else { observer.next(PATIENCE) };
            match received {
                Ok(lease) => {
                    let (step, checksum) = (lease.step(), checksum(&lease));
                    Event::Batch { at: now(), incarnation, group, step, checksum, is_correct: true }.report();
                    held.push((lease, checksum));
                }
                Err(ServiceError::TimedOut { .. } | ServiceError::TooManyBatchesHeld { .. }) => {}
                Err(error) => {
                    Event::error("observe", &error, Some(engine)).report();
                    break;
                }
            }
            while held.len() > habit.holds {
                check_unchanged(held.remove(0));
            }
            std::thread::sleep(Duration::from_millis(draws.integers(0, habit.pause + 1) as u64));
        }
        held.into_iter().for_each(check_unchanged);
    }
    Event::End.report();
}

/// Reports a batch that no longer has the checksum that it had when it was received.
pub fn check_unchanged((lease, sum): (BatchLease, u32)) {
    if checksum(&lease) != sum {
        let (group, step) = (lease.group(), lease.step());
        Event::Wrong { what: format!("group {group}: batch {step} changed while it was held") }.report();
    }
}

/// Lists engines and tries to become a trainer, `times` times or until standard input ends.
pub fn visit(seed: u64, times: usize) {
    let stop = stop_at_end_of_input();
    let mut draws = Generator::from_seed(seed);
    for _ in 0..times {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        Event::Connecting { at: now() }.report();
        if let Err(error) = running_engines(&Namespace::default()) {
            Event::error("list", &error, None).report();
        }
        if draws.integers(0, 8) == 0 {
            let config = ConnectConfig::new(SERVICE).timeout(Duration::ZERO);
            match Trainer::connect(&config) {
                // The trainer has just died, or has not started yet.
                Ok(trainer) => drop(trainer),
                Err(error) => Event::error("visit", &error, None).report(),
            }
        }
        std::thread::sleep(Duration::from_millis(draws.integers(1, 60) as u64));
    }
    Event::End.report();
}

/// Tries as another user to list engines, to connect, and to remove files.
pub fn intrude() {
    let namespace = Namespace::default();
    if running_engines(&namespace).is_ok_and(|engines| !engines.is_empty()) {
        Event::Broken { what: "another user sees the engine".to_owned() }.report();
    }
    let config = ConnectConfig::new(SERVICE).timeout(Duration::ZERO);
    if Trainer::connect(&config).is_ok() || Observer::connect(&config, 0).is_ok() {
        Event::Broken { what: "another user can connect".to_owned() }.report();
    }
    for path in cleanliness::files(&namespace) {
        if std::fs::remove_file(&path).is_ok() {
            Event::Broken { what: format!("another user can remove {}", path.display()) }.report();
        }
    }
    Event::End.report();
}
