//! What threads pay to divide a step among them, for the costs of `benches/dispatch_model.py`: `cargo bench --bench handover`.
//!
//! Two threads on two cores take turns. Printed are medians in nanoseconds.

use std::hint::{black_box, spin_loop};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Instant;

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

const ROUNDS: usize = 31;
const TURNS: u64 = 20_000;
/// Lines that are read at once.
const LINES: usize = 16;

/// A number on a cache line of its own, and not on its neighbour's pair.
#[repr(align(128))]
#[derive(Default)]
struct Line(AtomicU64);

impl Line {
    fn wait_for(&self, value: u64) {
        while self.0.load(Ordering::Acquire) != value {
            spin_loop();
        }
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Nanoseconds of one of `count` repetitions.
fn timed(count: u64, mut work: impl FnMut(u64)) -> f64 {
    let start = Instant::now();
    (0..count).for_each(&mut work);
    start.elapsed().as_nanos() as f64 / count as f64
}

fn pin(core: usize) {
    let mut set = CpuSet::new();
    set.set(core);
    sched_setaffinity(None, &set).unwrap();
}

/// Nanoseconds from a write of one core, to that line and to `others`, until another core has seen them.
fn handover(cores: [usize; 2], others: usize) -> f64 {
    let (there, back) = (Line::default(), Line::default());
    let written: Vec<Line> = (0..others).map(|_| Line::default()).collect();
    thread::scope(|scope| {
        scope.spawn(|| {
            pin(cores[1]);
            for turn in 1..=TURNS {
                there.wait_for(turn);
                let sum: u64 = written.iter().map(|line| line.0.load(Ordering::Relaxed)).sum();
                black_box(sum);
                back.0.store(turn, Ordering::Release);
            }
        });
        pin(cores[0]);
        timed(TURNS, |turn| {
            for line in &written {
                line.0.store(turn, Ordering::Relaxed);
            }
            there.0.store(turn + 1, Ordering::Release);
            back.wait_for(turn + 1);
        })
    })
}

fn main() {
    let allowed = sched_getaffinity(None).unwrap();
    let mut cores = (0..CpuSet::MAX_CPU).filter(|core| allowed.is_set(*core));
    let (Some(first), Some(second)) = (cores.next(), cores.next()) else {
        eprintln!("handover: needs 2 cores, got 1");
        std::process::exit(1);
    };
    let mutex = Mutex::new(0_u64);
    let mut results = [const { Vec::new() }; 3];
    for _ in 0..ROUNDS {
        let line = handover([first, second], 0);
        // There and back.
        results[0].push(line / 2.0);
        // The other core's lines are also written again, in which they are taken back.
        results[1].push((handover([first, second], LINES) - line) / (2 * LINES) as f64);
        results[2].push(timed(TURNS, |turn| *black_box(&mutex).lock().unwrap() += turn));
    }
    for (name, values) in ["line", "next line", "lock"].into_iter().zip(results) {
        println!("{name:10} {:6.1}", median(values));
    }
}
