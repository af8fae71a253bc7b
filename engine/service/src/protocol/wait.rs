//! Waiting for a message: spin, then yield, then park until an event or a timeout.
//!
//! The order is based on measurements. Spinning catches messages that arrive within a few microseconds. Longer spinning
//! slows down a sender on the same core, so the waiter then yields. Parking comes last, because waking a parked waiter
//! costs the sender a system call.
//!
//! A waiter that receives its message before it parks leaves the event set. The sender's next notification then returns
//! without a system call, so a busy pair of processes never enters the kernel.

use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::{Thread, ThreadId};
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

/// A listener on which several threads wait, each for some groups. One of those that park, the leader, parks on the listener and
/// wakes the threads that wait for the groups of its events.
pub(crate) struct Doorbell {
    listener: Listener<Ipc>,
    parked: Mutex<Parked>,
}

#[derive(Default)]
struct Parked {
    has_leader: bool,
    waiters: Vec<Waiter>,
}

/// A parked thread.
struct Waiter {
    thread: Thread,
    /// The groups that it waits for, as bits.
    groups: u128,
    /// Whether it must poll again.
    is_rung: bool,
}

impl Doorbell {
    /// The ids of the listener's events are groups' numbers, or a larger one to wake any waiter.
    pub(crate) fn new(listener: Listener<Ipc>) -> Self {
        Doorbell { listener, parked: Mutex::default() }
    }

    /// Calls `poll` until it returns a value or `timeout` has passed, and parks until an event of one of `groups` between the
    /// calls. Spinning and yielding end a fixed time after `since`, the time of the last message, so that repeated calls without
    /// a message park at once. A signal ends the wait as the timeout does. An event of a group that no thread waits for wakes
    /// any thread.
    pub(crate) fn wait<T>(
        &self,
        groups: &Range<usize>,
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
                    let mut found = None;
                    let mut poll_once = || {
                        found = poll()?;
                        Ok(found.is_some())
                    };
                    let is_over = !self.park(groups, timeout - waited, &mut poll_once)?;
                    if found.is_some() {
                        return Ok(found);
                    }
                    if is_over {
                        return poll();
                    }
                }
            }
        }
    }

    /// Parks until an event or the timeout, unless `poll` returns true. Returns `false` after a signal.
    fn park(
        &self,
        groups: &Range<usize>,
        timeout: Duration,
        poll: &mut dyn FnMut() -> Result<bool, ServiceError>,
    ) -> Result<bool, ServiceError> {
        let end = Instant::now() + timeout;
        let mut parked = self.parked();
        // Under the lock: what comes later wakes this thread, whoever takes the event.
        if poll()? {
            return Ok(true);
        }
        let groups = groups.clone().fold(0, |bits, group| bits | bit(group));
        let thread = std::thread::current();
        let id = thread.id();
        parked.waiters.push(Waiter { thread, groups, is_rung: false });
        let outcome = loop {
            let left = end.saturating_duration_since(Instant::now());
            if parked.waiters.iter().any(|waiter| waiter.is_rung && waiter.thread.id() == id) || left.is_zero() {
                break Ok(true);
            }
            if parked.has_leader {
                drop(parked);
                std::thread::park_timeout(left);
                parked = self.parked();
                continue;
            }
            parked.has_leader = true;
            drop(parked);
            let mut events = 0;
            let timeout = left.max(SHORTEST_PARK);
            let waited = self.listener.timed_wait(|event| events |= bit(event.id.as_value()), timeout);
            parked = self.parked();
            parked.has_leader = false;
            parked.ring(events, id);
            match waited {
                Ok(_) => {}
                Err(ListenerWaitError::InterruptSignal) => break Ok(false),
                Err(e) => break Err(ServiceError::middleware("cannot wait for a message")(e)),
            }
        };
        parked.waiters.retain(|waiter| waiter.thread.id() != id);
        // Another thread must lead.
        if let (false, Some(next)) = (parked.has_leader, parked.waiters.first()) {
            next.thread.unpark();
        }
        outcome
    }

    fn parked(&self) -> MutexGuard<'_, Parked> {
        lock(&self.parked)
    }
}

impl Parked {
    /// Wakes the waiters of these events. The leader polls for those that nobody waits for.
    fn ring(&mut self, events: u128, leader: ThreadId) {
        let mut unheard = events;
        for waiter in self.waiters.iter_mut().filter(|waiter| waiter.groups & events != 0) {
            unheard &= !waiter.groups;
            waiter.is_rung = true;
            waiter.thread.unpark();
        }
        let leader = self.waiters.iter_mut().find(|waiter| waiter.thread.id() == leader);
        leader.into_iter().for_each(|leader| leader.is_rung |= unheard != 0);
    }
}

/// The bit of an event's id, at most [`MAX_GROUPS`](crate::MAX_GROUPS).
fn bit(id: usize) -> u128 {
    1_u128.checked_shl(id as u32).unwrap_or_default()
}

/// Locks a mutex, even one that was held during a panic.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

    use super::*;
    use crate::namespace::directory::Namespace;
    use crate::namespace::node::NamespaceNode;
    use crate::protocol::ports;

    #[test]
    fn a_timeout_below_a_microsecond_does_not_block_forever() {
        let root = format!("/tmp/endless-wait-{}", std::process::id());
        let node = NamespaceNode::join(&Namespace::at(&root), Duration::ZERO).unwrap();
        let service = node.service_builder(&"wait".try_into().unwrap()).event().create().unwrap();
        let doorbell = Doorbell::new(ports::listener(&service).unwrap());
        for timeout in [Duration::from_nanos(1), Duration::ZERO] {
            assert!(doorbell.park(&(0..1), timeout, &mut || Ok(false)).unwrap());
        }
        drop(doorbell);
        drop(node);
        std::fs::remove_dir_all(root).unwrap();
    }

    /// Each thread waits for one group, and only the leader sees the listener's events.
    #[test]
    fn each_thread_wakes_for_its_own_group_and_another_leads_when_the_leader_leaves() {
        let root = format!("/tmp/endless-bell-{}", std::process::id());
        let node = NamespaceNode::join(&Namespace::at(&root), Duration::ZERO).unwrap();
        let builder = node.service_builder(&"bell".try_into().unwrap()).event().event_id_max_value(3);
        let events = builder.create().unwrap();
        let doorbell = Doorbell::new(ports::listener(&events).unwrap());
        let notifier = ports::notifier(&events).unwrap();
        let (long, past) = (Duration::from_secs(30), Instant::now() - YIELD);
        let sent: [AtomicUsize; 3] = Default::default();
        std::thread::scope(|scope| {
            for group in 0..3 {
                let (doorbell, sent) = (&doorbell, &sent);
                scope.spawn(move || {
                    for number in 1..=200 {
                        let poll = || Ok((sent[group].load(Ordering::SeqCst) >= number).then_some(()));
                        assert_eq!(doorbell.wait(&(group..group + 1), long, past, poll).unwrap(), Some(()));
                    }
                });
            }
            for number in 1..=200 {
                // The groups of threads that have left, too.
                for group in [2, 0, 1] {
                    sent[group].store(number, Ordering::SeqCst);
                    ports::notify(&notifier, group);
                    std::thread::sleep(Duration::from_micros(100 * (number % 3) as u64));
                }
            }
        });
        // An event that no group has wakes any waiter.
        let rung = AtomicBool::new(false);
        let poll = || Ok(rung.load(Ordering::SeqCst).then_some(()));
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| doorbell.wait(&(0..1), long, past, &poll).unwrap());
            while !doorbell.parked().has_leader {
                std::thread::yield_now();
            }
            rung.store(true, Ordering::SeqCst);
            ports::notify(&notifier, 3);
            assert_eq!(waiting.join().unwrap(), Some(()));
        });
        assert!(doorbell.parked().waiters.is_empty());
        drop((doorbell, notifier, events));
        drop(node);
        std::fs::remove_dir_all(root).unwrap();
    }
}
