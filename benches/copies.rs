//! Steps per second of a reader that needs its own copy of all observations: copied whole, and kept up to date from the changes that
//! the pool notes. Both in turn in one run, with 1,024 environments and one thread. `cargo bench --bench copies`; further arguments
//! are ids.

mod actions;

use std::time::{Duration, Instant};

use endless_gym::batch::{Batch, Block, ObservationCopy, zeroed};
use endless_gym::envs::{self, EnvSpec};
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};

use actions::Actions;

const NUM_ENVS: usize = 1024;
const WARM_UP: usize = 20;
const STEPS: usize = 50;
const ROUNDS: usize = 15;

/// A pool and a reader of its batches.
struct Reader {
    pool: Pool,
    actions: Actions,
    buffers: Vec<Vec<Block>>,
    written: usize,
    read: fn(&mut Reader, usize),
    whole: Vec<u8>,
    copy: ObservationCopy,
}

impl Reader {
    fn new(spec: &'static EnvSpec, changes: bool, buffers: usize, read: fn(&mut Reader, usize)) -> Self {
        let seeding = Seeding::Continue { seed: Some(1) };
        let config = PoolConfig { seeding, changes, ..PoolConfig::new(spec.id, NUM_ENVS) };
        let mut pool = Pool::new(&config, &Threads::new(1).unwrap()).unwrap();
        let copy = ObservationCopy::new(pool.layout()).unwrap();
        let mut buffers = vec![zeroed(pool.layout().blocks()); buffers];
        pool.reset(ResetRequest::All, &mut buffers[0]).unwrap();
        let whole = Batch::new(pool.layout(), &buffers[0]).observation().to_vec();
        let mut reader = Reader { pool, actions: Actions::new(spec, NUM_ENVS), buffers, written: 0, read, whole, copy };
        reader.time(WARM_UP);
        reader
    }

    fn time(&mut self, steps: usize) -> Duration {
        let start = Instant::now();
        for _ in 0..steps {
            self.written = (self.written + 1) % self.buffers.len();
            self.pool.step(self.actions.next(), &mut self.buffers[self.written]).unwrap();
            (self.read)(self, self.written);
        }
        start.elapsed()
    }
}

fn nothing(_: &mut Reader, _: usize) {}

fn everything(reader: &mut Reader, buffer: usize) {
    reader.whole.copy_from_slice(Batch::new(reader.pool.layout(), &reader.buffers[buffer]).observation());
}

fn changes(reader: &mut Reader, buffer: usize) {
    reader.copy.apply(&Batch::new(reader.pool.layout(), &reader.buffers[buffer])).unwrap();
}

fn median(mut numbers: Vec<f64>) -> f64 {
    numbers.sort_unstable_by(f64::total_cmp);
    numbers[numbers.len() / 2]
}

fn main() {
    let ids: Vec<_> = std::env::args().skip(1).filter(|argument| !argument.starts_with('-')).collect();
    println!("medians of {ROUNDS} rounds of {STEPS} steps; thousands of steps per second, and ratios");
    println!(
        "{:30} {:>7} {:>9} {:>9} {:>9} {:>9} {:>8} {:>9}",
        "id", "buffers", "uncopied", "noted", "whole", "changes", "ratio", "cost"
    );
    for (spec, buffers) in envs::specs().flat_map(|spec| [(spec, 1), (spec, 2)]) {
        if !ids.is_empty() && !ids.iter().any(|id| id == spec.id) {
            continue;
        }
        // The step alone, the step that notes changes, and both kinds of copies.
        let mut readers =
            [(false, nothing as fn(&mut Reader, usize)), (true, nothing), (false, everything), (true, changes)]
                .map(|(changes, read)| Reader::new(spec, changes, buffers, read));
        let mut speeds: [Vec<f64>; 4] = Default::default();
        for _ in 0..ROUNDS {
            for (reader, speeds) in readers.iter_mut().zip(&mut speeds) {
                speeds.push((STEPS * NUM_ENVS) as f64 / reader.time(STEPS).as_secs_f64() / 1e3);
            }
        }
        let ratio =
            |one: &[f64], other: &[f64]| median(one.iter().zip(other).map(|(one, other)| one / other).collect());
        let (copies, cost) = (ratio(&speeds[3], &speeds[2]), ratio(&speeds[0], &speeds[1]));
        let [uncopied, noted, whole, changed] = speeds.map(median);
        println!(
            "{:30} {buffers:7} {uncopied:9.0} {noted:9.0} {whole:9.0} {changed:9.0} {copies:8.2} {cost:9.2}",
            spec.id
        );
    }
}
