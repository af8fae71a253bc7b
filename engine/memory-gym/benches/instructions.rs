//! Steps of every environment for an instruction counter: `cargo xtask instructions` runs it under callgrind.
//!
//! It prints and measures nothing itself. Its argument is an environment id; callgrind counts the instructions of
//! `counted_steps`.

use endless_gym_core::batch::{Block, zeroed};
use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};
use endless_gym_core::random::Generator;
use endless_gym_memory_gym::memory_gym;

const NUM_ENVS: usize = 16;
const WARM_UP: usize = 20;
const STEPS: usize = 250;

fn main() {
    let id = std::env::args().nth(1).unwrap_or_default();
    // A plain `cargo bench` passes no id.
    let Ok(spec) = memory_gym().spec(&id) else { return };
    let config = PoolConfig::new(spec.id, NUM_ENVS).seeding(Seeding::Continue { seed: Some(1) });
    let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).unwrap();
    let mut batch = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::All, &mut batch).unwrap();
    let mut random = Generator::from_seed(1);
    let mut actions = || (0..NUM_ENVS).flat_map(|_| spec.action_space.sample(&mut random)).collect();
    let actions: Vec<Vec<i32>> = (0..WARM_UP + STEPS).map(|_| actions()).collect();
    let (warm_up, counted) = actions.split_at(WARM_UP);
    steps(&mut pool, warm_up, &mut batch);
    counted_steps(&mut pool, counted, &mut batch);
}

/// The counted function.
#[inline(never)]
fn counted_steps(pool: &mut Pool, actions: &[Vec<i32>], batch: &mut [Block]) {
    steps(pool, actions, batch);
}

fn steps(pool: &mut Pool, actions: &[Vec<i32>], batch: &mut [Block]) {
    actions.iter().for_each(|actions| pool.step(actions, batch).unwrap());
}
