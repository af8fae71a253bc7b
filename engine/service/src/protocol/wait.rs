//! Waiting for a message: spin, then yield, then park until an event or a timeout.
//!
//! The order is based on measurements. Spinning catches messages that arrive within a few microseconds. Longer spinning
//! slows down a sender on the same core, so the waiter then yields. Parking comes last, because waking a parked waiter
//! costs the sender a system call.
//!
//! A waiter that receives its message before it parks leaves the event set. The sender's next notification then returns
//! without a system call, so a busy pair of processes never enters the kernel.

use std::time::{Duration, Instant};

use iceoryx2::port::listener::{Listener, ListenerWaitError};

use crate::error::ServiceError;
use crate::namespace::directory::Ipc;

/// How long a trainer or an observer waits for a message before it checks whether the engine is running.
pub(crate) const LIVENESS_INTERVAL: Duration = Duration::from_millis(200);

/// How long a waiter spins.
const SPIN: Duration = Duration::from_micros(3);
/// How long a waiter spins and yields before it parks: longer than most trainers need between two steps and most engines need for
/// one. Waking a parked waiter takes up to half a millisecond on a virtual machine, during which the sender may park in turn.
const YIELD: Duration = Duration::from_millis(3);

/// Shortest timeout of a parked waiter. iceoryx2 passes whole microseconds to the kernel, which takes 0 for no timeout.
const SHORTEST_PARK: Duration = Duration::from_micros(1);

/// Calls `poll` until it returns a value or `timeout` has passed, and parks on `listener` between the calls. Spinning
/// and yielding end a fixed time after `since`, the time of the last message, so that repeated calls without a message
/// park at once. A signal ends the wait as the timeout does.
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
            _ => {
                if !park(listener, timeout - waited)? {
                    return poll();
                }
            }
        }
    }
}

/// Parks until an event or the timeout. Returns `false` after a signal.
fn park(listener: &Listener<Ipc>, timeout: Duration) -> Result<bool, ServiceError> {
    match listener.timed_wait(|_| {}, timeout.max(SHORTEST_PARK)) {
        Ok(_) => Ok(true),
        Err(ListenerWaitError::InterruptSignal) => Ok(false),
        Err(e) => Err(ServiceError::middleware("cannot wait for a message")(e)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::namespace::directory::Namespace;
    use crate::namespace::node::NamespaceNode;
    use crate::protocol::ports::{self, EngineServices, OpenMode, ServiceNames};

    #[test]
    fn a_timeout_below_a_microsecond_does_not_block_forever() {
        let root = format!("/tmp/endless-wait-{}", std::process::id());
        let node = NamespaceNode::join(&Namespace::at(&root), Duration::ZERO).unwrap();
        let services = EngineServices { node: &node, names: ServiceNames::new("wait", 1), mode: OpenMode::Create };
        let listener = ports::listener(&services.events("to_engine", 1).unwrap()).unwrap();
        assert!(park(&listener, Duration::from_nanos(1)).unwrap());
        assert!(park(&listener, Duration::ZERO).unwrap());
        drop(listener);
        drop(node);
        std::fs::remove_dir_all(root).unwrap();
    }
}
