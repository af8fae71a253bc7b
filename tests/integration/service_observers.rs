//! Observers that wait: they sleep until a batch comes, and cannot hold up the engine or each other.

use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use endless_gym::memory_gym;
use endless_gym::service::{Engine, EngineStatus, Observer, Observers};

use crate::support::place::Place;
use crate::support::process::{TIMEOUT, wait_until};
use crate::support::service::{play, reset, step};

/// How often this thread has gone to sleep.
fn sleeps() -> u64 {
    let status = std::fs::read_to_string("/proc/thread-self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:")).unwrap();
    line.trim().parse().unwrap()
}

#[test]
fn a_waiting_observer_sleeps_until_a_batch_of_its_group() {
    let (place, _engine, mut trainer) = Place::started(2, 2);
    (0..2).for_each(|group| drop(reset(&mut trainer, group)));
    let mut observer = Observer::connect(&place.connect_config("gym"), 0).unwrap();
    let (seen, sleeps) = std::thread::scope(|scope| {
        let waiting = scope.spawn(|| {
            let before = sleeps();
            (observer.next(TIMEOUT).unwrap().step(), sleeps() - before)
        });
        // The other group must not wake it. Polls every millisecond would be more than these, too.
        let start = Instant::now();
        let mut steps = 0;
        while steps < 300 || start.elapsed() < Duration::from_secs(1) {
            step(&mut trainer, 1);
            steps += 1;
        }
        assert!(!waiting.is_finished());
        step(&mut trainer, 0);
        waiting.join().unwrap()
    });
    assert_eq!(seen, 2);
    assert!(sleeps < 100, "{sleeps} sleeps");
}

#[test]
fn a_batch_wakes_an_observer_at_once() {
    let (place, _engine, mut trainer) = Place::started(2, 2);
    (0..2).for_each(|group| drop(reset(&mut trainer, group)));
    for all in [false, true] {
        let group = (!all).then_some(1);
        let mut observers = Observers::connect(&place.connect_config("gym"), group).unwrap();
        let (to_trainer, wanted) = channel();
        let fastest = std::thread::scope(|scope| {
            let trainer = &mut trainer;
            let stepping = scope.spawn(move || {
                wanted
                    .into_iter()
                    .map(|group| {
                        // The observer waits by now.
                        std::thread::sleep(Duration::from_micros(500));
                        let start = Instant::now();
                        (step(trainer, group).step(), start)
                    })
                    .collect::<Vec<_>>()
            });
            let mut seen = Vec::new();
            for round in 0..100 {
                let group = if all { round % 2 } else { 1 };
                to_trainer.send(group).unwrap();
                let observed = observers.next(TIMEOUT).unwrap();
                assert_eq!((observed.lease.group(), observed.missed), (group, 0));
                seen.push((observed.lease.step(), Instant::now()));
            }
            drop(to_trainer);
            let sent = stepping.join().unwrap();
            sent.iter()
                .zip(seen)
                .map(|(sent, seen)| {
                    assert_eq!(sent.0, seen.0);
                    seen.1 - sent.1
                })
                .min()
                .unwrap()
        });
        // Polls of a millisecond find a batch that comes half a millisecond after the last poll later than this.
        assert!(fastest < Duration::from_micros(400), "{fastest:?}");
    }
}

/// Observers die and stop while they wait and while they wake others.
#[test]
fn dead_and_stopped_observers_hold_up_nobody() {
    let place = Place::new();
    let config = place.engine_config("gym", 2, 2).observers(16);
    let engine = Engine::new(memory_gym(), &config).unwrap().spawn().unwrap();
    std::thread::scope(|scope| {
        let place = &place;
        let mut others: Vec<_> = (0..6).map(|_| place.role("observer gym")).collect();
        wait_until("six observers", || {
            let status = EngineStatus::of(place.namespace(), "gym");
            status.is_some_and(|status| status.groups.iter().all(|group| group.observers.len() == 6))
        });
        let mut trainer = place.trainer("gym").unwrap();
        let mut observers = Observers::connect(&place.connect_config("gym"), None).unwrap();
        let seen = scope.spawn(move || {
            let mut seen = 0;
            while observers.next(TIMEOUT).unwrap().lease.step() < 1501 {
                seen += 1;
            }
            seen
        });
        others[0].stop();
        for other in &mut others[1..4] {
            (0..2).for_each(|group| play(&mut trainer, group, 100));
            other.kill();
        }
        while !seen.is_finished() {
            step(&mut trainer, 0);
        }
        assert!(seen.join().unwrap() > 0);
        drop(others);
    });
    engine.stop();
    assert!(engine.join().unwrap().batches > 1500);
}
