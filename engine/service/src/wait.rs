//! Waiting for a message: spin, then yield, then park until an event or a timeout.
//!
//! The order is based on measurements. Spinning receives a message that arrives within a few microseconds. Spinning longer slows
//! the sender down if both processes share a core, so the waiter then yields. Parking comes last, because waking a parked waiter
//! costs the sender a system call.
//!
//! A waiter that receives its message before it parks leaves the event set. The sender's next notification finds the event set
//! and returns without a system call, so a busy pair of processes does not enter the kernel.

use std::time::{Duration, Instant};

use iceoryx2::port::listener::{Listener, ListenerWaitError};

use crate::error::ServiceError;
use crate::namespace::Ipc;

/// Liveness interval: how long a trainer or an observer waits for a message before it checks whether the engine is running.
pub(crate) const LIVENESS_INTERVAL: Duration = Duration::from_millis(200);

/// How long a waiter spins.
const SPIN: Duration = Duration::from_micros(3);
/// How long a waiter spins and yields before it parks: longer than most trainers need between two steps and most engines need for
/// one. Waking a parked waiter takes up to half a millisecond on a virtual machine, during which the sender may park in turn.
const YIELD: Duration = Duration::from_millis(3);

/// Calls `poll` until it returns a value or `timeout` has passed, and parks on `listener` between the calls. Spinning and
/// yielding end a fixed time after `since`, the time of the last message, so that repeated calls without a message park at once.
/// A signal ends the wait like the timeout.
pub(crate) fn wait<T>(
    listener: &Listener<Ipc>,
    timeout: Duration,
    since: Instant,
    mut poll: impl FnMut() -> Result<Option<T>, ServiceError>,
) -> Result<Option<T>, ServiceError> {
    let start = Instant::now();
    loop {
        if let Some(found) = poll()? {
            return Ok(Some(found));
        }
        let waited = start.elapsed();
        if waited >= timeout {
            return Ok(None);
        }
        match since.elapsed() {
            quiet if quiet < SPIN => std::hint::spin_loop(),
            quiet if quiet < YIELD => std::thread::yield_now(),
            _ => match listener.timed_wait(|_| {}, timeout - waited) {
                Ok(_) => {}
                Err(ListenerWaitError::InterruptSignal) => return poll(),
                Err(e) => return Err(ServiceError::middleware("cannot wait for a message")(e.to_string())),
            },
        }
    }
}
