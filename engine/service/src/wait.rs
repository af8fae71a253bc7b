//! Waiting for the other side: spin, yield, then sleep until an event or a time-out.
//!
//! The order is measured. A message that comes within a few microseconds is met by spinning. Spinning longer hurts where both
//! processes share a core, so the processor is offered to others next. Only then does the waiter go to sleep, which costs the
//! other side a system call to wake it.
//!
//! A waiter that found its message while awake leaves the event pending. The sender's next notification then finds it set and
//! returns without a system call: a busy pair of processes never enters the kernel.

use std::time::{Duration, Instant};

use iceoryx2::port::listener::{Listener, ListenerWaitError};

use super::error::ServiceError;
use super::node::Ipc;

const SPIN: Duration = Duration::from_micros(3);
/// As long as most trainers take between two steps, and most engines for one. Waking a sleeper takes up to half a millisecond on a
/// virtual machine, in which the other side may fall asleep in turn.
const YIELD: Duration = Duration::from_millis(3);

/// Calls `poll` until it yields something or `timeout` has passed; sleeps on `listener` in between. How long it stays awake is
/// counted from `since`, when there last was a message, so that one who waits in vain again and again sleeps. An interrupting
/// signal counts as a time-out.
pub(super) fn wait<T>(
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
                Err(e) => return Err(ServiceError::middleware("cannot wait for the other side")(e.to_string())),
            },
        }
    }
}
