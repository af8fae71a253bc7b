//! Snapshots for a search: tries every action of one environment from the same state, and plays the one whose random
//! continuations return the most. The search uses rewards only.
//!
//! ```console
//! cargo run --release --example tree_search [SEED]
//! ```

use std::error::Error;

use endless_gym::batch::{Batch, Block, zeroed};
use endless_gym::memory_gym;
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Threads};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use serde_json::json;

const ID: &str = "MysteryPath-Grid-v0";
const ACTIONS: i32 = 4;
/// Random continuations of each action, and their length in steps.
const ROLLOUTS: usize = 40;
const DEPTH: usize = 8;
const DISCOUNT: f64 = 0.9;
const MAX_STEPS: usize = 128;

fn main() -> Result<(), Box<dyn Error>> {
    let seed = std::env::args().nth(1).map_or(Ok(1), |seed| seed.parse())?;
    // One environment is played; the others continue from its snapshots, all rollouts in one step.
    let mut played = new_pool(1)?;
    let mut imagined = new_pool(ACTIONS as usize * ROLLOUTS)?;
    let mut blocks = zeroed(played.layout().blocks());
    let mut imagined_blocks = zeroed(imagined.layout().blocks());
    played.reset(ResetRequest::Seed(seed), &mut blocks)?;
    imagined.reset(ResetRequest::Seed(0), &mut imagined_blocks)?;

    let mut random = SmallRng::seed_from_u64(seed);
    let mut total = 0.0;
    for step in 1..=MAX_STEPS {
        let snapshot = played.snapshot(0)?;
        let action = search(&mut imagined, &mut imagined_blocks, &snapshot, &mut random)?;
        played.step(&[action], &mut blocks)?;
        let batch = Batch::new(played.layout(), &blocks);
        total += batch.reward()[0];
        if batch.terminated()[0] == 1 {
            println!("seed {seed}: the episode ended after {step} steps with a return of {total:.2}");
            return Ok(());
        }
    }
    println!("seed {seed}: a return of {total:.2} after {MAX_STEPS} steps");
    Ok(())
}

fn new_pool(num_envs: usize) -> Result<Pool, Box<dyn Error>> {
    let options = json!({"reward_path_progress": 0.1, "show_goal": true});
    let mut config = PoolConfig::new(ID, num_envs);
    // The search uses rewards only, so nothing is drawn.
    config.frames = None;
    config.options = serde_json::from_value(options).map(endless_gym::pool::ResetOptions::Shared)?;
    Ok(Pool::new(memory_gym(), &config, &Threads::new(1)?)?)
}

/// The action whose random continuations return the most.
fn search(
    pool: &mut Pool,
    blocks: &mut [Block],
    snapshot: &[u8],
    random: &mut SmallRng,
) -> Result<i32, Box<dyn Error>> {
    let num_envs = pool.layout().num_envs();
    for env in 0..num_envs {
        pool.restore(env, snapshot)?;
    }
    let first = |env: usize| (env / ROLLOUTS) as i32;
    let mut values = vec![0.0; ACTIONS as usize];
    let mut playing = vec![true; num_envs];
    for depth in 0..DEPTH {
        let action = |env| if depth == 0 { first(env) } else { random.random_range(0..ACTIONS) };
        let actions: Vec<i32> = (0..num_envs).map(action).collect();
        pool.step(&actions, blocks)?;
        let batch = Batch::new(pool.layout(), blocks);
        for env in 0..num_envs {
            if playing[env] {
                values[first(env) as usize] += batch.reward()[env] * DISCOUNT.powi(depth as i32);
                playing[env] = batch.terminated()[env] == 0;
            }
        }
    }
    // Of equal actions a random one, so that the agent does not stand still where nothing is in reach.
    let best = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let candidates: Vec<i32> = (0..ACTIONS).filter(|action| values[*action as usize] >= best).collect();
    Ok(candidates[random.random_range(0..candidates.len())])
}
