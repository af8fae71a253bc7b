//! A trainer in a process of its own, beside `endless serve --service NAME`.
//!
//! ```console
//! cargo run --release -- serve --env MysteryPath-v0 --num-envs 64 --service example &
//! cargo run --release --example trainer example
//! ```

use std::error::Error;
use std::time::Duration;

use endless_gym::pool::ResetRequest;
use endless_gym::service::{ConnectConfig, Trainer};

const STEPS: usize = 1_000;
const TIMEOUT: Duration = Duration::from_secs(10);

fn main() -> Result<(), Box<dyn Error>> {
    let service = std::env::args().nth(1).unwrap_or_else(|| "endless".to_owned());
    let mut trainer = Trainer::connect(&ConnectConfig::new(&service).timeout(TIMEOUT))?;
    let num_envs = trainer.specification().num_envs;
    let branches = trainer.specification().action_space.width();

    trainer.reset(0, ResetRequest::Seed(0))?;
    let mut reward = 0.0;
    for _ in 0..STEPS {
        let lease = trainer.receive(0, TIMEOUT)?;
        // The arrays are slices into shared memory. The engine does not write to them while the lease exists.
        let batch = lease.batch();
        reward += batch.reward().iter().sum::<f64>();
        let actions = policy(batch.observation(), num_envs * branches);
        drop(lease);
        trainer.send(0, &actions)?;
    }
    trainer.receive(0, TIMEOUT)?;
    println!("{STEPS} steps of {num_envs} environments, mean reward {:.4}", reward / (STEPS * num_envs) as f64);
    Ok(())
}

/// Stands for a neural network: uint8 frames in, int32 actions out.
fn policy(_observation: &[u8], numbers: usize) -> Vec<i32> {
    vec![1; numbers]
}
