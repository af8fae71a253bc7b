//! An observer watches a trainer's batches as they come.
//!
//! ```console
//! cargo run --release --example observer example     # beside the engine and the trainer of the example `trainer`
//! ```

use std::error::Error;
use std::time::{Duration, Instant};

use endless_gym::service::{ConnectConfig, Observer, ServiceError};

/// How long to wait for the engine to start, and for a batch before looking whether it still runs.
const TIMEOUT: Duration = Duration::from_secs(10);
const NEXT_TIMEOUT: Duration = Duration::from_millis(500);
const REPORT_EVERY: Duration = Duration::from_secs(1);

fn main() -> Result<(), Box<dyn Error>> {
    let service = std::env::args().nth(1).unwrap_or_else(|| "endless".to_owned());
    let mut observer = Observer::connect(&ConnectConfig::new(&service).timeout(TIMEOUT), 0)?;
    let num_envs = observer.specification().num_envs;
    println!("watching {service}");
    let (mut first, mut since) = (None, Instant::now());
    loop {
        // A slow observer misses batches; `step` numbers them all.
        let lease = match observer.next(NEXT_TIMEOUT) {
            Err(ServiceError::TimedOut { .. }) => continue,
            Err(ServiceError::EngineLost { .. }) => break,
            lease => lease?,
        };
        let step = lease.step();
        let seen = *first.get_or_insert(step);
        if since.elapsed() >= REPORT_EVERY {
            let rate = (step - seen) as f64 * num_envs as f64 / since.elapsed().as_secs_f64();
            println!(
                "step {step}: {rate:.0} steps per second, rewards {:?}",
                &lease.batch().reward()[..num_envs.min(4)]
            );
            (first, since) = (None, Instant::now());
        }
    }
    println!("the engine has ended");
    Ok(())
}
