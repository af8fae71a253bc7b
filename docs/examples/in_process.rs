//! Many environments in this process: random actions, steps per second, mean return.
//!
//! ```console
//! cargo run --release --example in_process [ID] [NUM_ENVS]
//! ```

use std::error::Error;
use std::time::Instant;

use endless_gym::batch::{Batch, zeroed};
use endless_gym::memory_gym;
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Threads};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

const STEPS: usize = 1_000;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let id = arguments.next().unwrap_or_else(|| "MortarMayhem-Grid-v0".to_owned());
    let num_envs = arguments.next().map_or(Ok(256), |number| number.parse())?;

    let mut pool = Pool::new(memory_gym(), &PoolConfig::new(&id, num_envs), &Threads::new(0)?)?;
    let mut blocks = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::Seed(0), &mut blocks)?;

    let mut random = SmallRng::seed_from_u64(0);
    let branches = pool.spec().action_space.branches().to_vec();
    let mut actions = vec![0; num_envs * branches.len()];
    let (mut episodes, mut returns) = (0, 0.0);
    let start = Instant::now();
    for _ in 0..STEPS {
        for action in actions.chunks_exact_mut(branches.len()) {
            for (number, choices) in action.iter_mut().zip(&branches) {
                *number = random.random_range(0..*choices);
            }
        }
        pool.step(&actions, &mut blocks)?;
        let batch = Batch::new(pool.layout(), &blocks);
        for (env, terminated) in batch.terminated().iter().enumerate() {
            if *terminated == 1 {
                episodes += 1;
                returns += batch.episode_return()[env];
            }
        }
    }
    let steps = (STEPS * num_envs) as f64;
    println!("{id}: {:.0} steps per second", steps / start.elapsed().as_secs_f64());
    println!("{episodes} episodes, mean return {:.3}", returns / f64::from(episodes));
    Ok(())
}
