//! Steps of every environment for an instruction counter: `cargo xtask instructions` runs it under callgrind.
//!
//! It prints and measures nothing itself. Its argument is an environment id; callgrind counts the instructions of
//! `steps`.

mod actions;

use endless_gym::batch::{Block, zeroed};
use endless_gym::memory_gym;
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};

use actions::Actions;

const NUM_ENVS: usize = 16;
const WARM_UP: usize = 20;
const STEPS: usize = 250;

fn main() {
    let id = std::env::args().nth(1).unwrap_or_default();
    // A plain `cargo bench` passes no id.
    let Ok(spec) = memory_gym().spec(&id) else { return };
    let config = PoolConfig { seeding: Seeding::Continue { seed: Some(1) }, ..PoolConfig::new(spec.id, NUM_ENVS) };
    let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).unwrap();
    let mut batch = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::All, &mut batch).unwrap();
    let mut actions = Actions::new(spec, NUM_ENVS);
    for _ in 0..WARM_UP {
        pool.step(actions.next(), &mut batch).unwrap();
    }
    steps(&mut pool, &mut actions, &mut batch);
}

/// The counted function.
#[inline(never)]
fn steps(pool: &mut Pool, actions: &mut Actions, batch: &mut [Block]) {
    for _ in 0..STEPS {
        pool.step(actions.next(), batch).unwrap();
    }
}
