//! Two groups in flight: the engine steps one group while the trainer computes the other's actions.
//!
//! ```console
//! cargo run --release --example two_groups
//! ```

use std::error::Error;
use std::time::{Duration, Instant};

use endless_gym::memory_gym;
use endless_gym::pool::{PoolConfig, ResetRequest};
use endless_gym::service::{ConnectConfig, Engine, EngineConfig, ServiceError, Trainer};

const SERVICE: &str = "two-groups";
const ID: &str = "MortarMayhem-v0";
const NUM_ENVS: usize = 64;
const STEPS: usize = 500;
const TIMEOUT: Duration = Duration::from_secs(10);
/// Simulated inference time of a policy.
const INFERENCE_TIME: Duration = Duration::from_micros(100);

fn main() -> Result<(), Box<dyn Error>> {
    // Usually a process of its own: `endless serve --groups 2 --service two-groups ...`.
    let config = EngineConfig::new(SERVICE, PoolConfig::new(ID, NUM_ENVS), 1);
    let engine = Engine::new(memory_gym(), &config.groups(2))?.spawn()?;
    let rate = (2 * STEPS * NUM_ENVS) as f64 / play()?.as_secs_f64();
    engine.stop();
    let summary = engine.join()?;
    println!("{rate:.0} steps per second with two groups; the engine sent {} batches", summary.batches);
    Ok(())
}

/// Plays both groups and returns how long it took.
fn play() -> Result<Duration, ServiceError> {
    let mut trainer = Trainer::connect(&ConnectConfig::new(SERVICE).timeout(TIMEOUT))?;
    let actions = vec![0; NUM_ENVS * trainer.specification().action_space.width()];
    for group in 0..2 {
        trainer.reset(group, ResetRequest::Seed(0))?;
    }
    let start = Instant::now();
    for _ in 0..2 * STEPS {
        // The group that is ready first.
        let group = trainer.receive_any(TIMEOUT)?.group();
        std::thread::sleep(INFERENCE_TIME);
        trainer.send(group, &actions)?;
    }
    // The engine is stopped after the answers to the last actions, not before.
    for _ in 0..2 {
        trainer.receive_any(TIMEOUT)?;
    }
    Ok(start.elapsed())
}
