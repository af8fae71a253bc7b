//! A time limit for targets, which also catches targets that never return.

use std::fmt::Debug;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

/// Maximum time for an input, thousands of times longer than usual to allow for a loaded machine.
pub const BUDGET: Duration = Duration::from_secs(60);

/// Calls `work`. If it takes longer than [`BUDGET`], prints the input and aborts the process.
pub(crate) fn within_budget<T>(input: impl Debug + Send + 'static, work: impl FnOnce() -> T) -> T {
    let (finished, wait) = channel::<()>();
    let watchdog = std::thread::spawn(move || {
        if wait.recv_timeout(BUDGET) == Err(RecvTimeoutError::Timeout) {
            let input: String = format!("{input:?}").chars().take(5000).collect();
            eprintln!("not finished after {BUDGET:?}: {input}");
            std::process::abort();
        }
    });
    let outcome = work();
    drop(finished);
    watchdog.join().expect("the watchdog does not panic");
    outcome
}
