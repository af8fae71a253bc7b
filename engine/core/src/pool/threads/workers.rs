//! Worker threads that join the calling thread in a step.
//!
//! A step takes tens of microseconds, less than waking a thread. So the caller starts at once and waits only for workers that
//! have joined: a running worker joins, and one that wakes too late finds the call closed. After a call, a worker spins, then
//! yields, then parks.
//!
//! To scale to many workers, each joins by its own flag and wakes a few others, which wake others in turn.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::time::Instant;

use crossbeam_utils::CachePadded;
use crossbeam_utils::sync::{Parker, Unparker};

use crate::pool::sync::threads::{
    Arc, AtomicBool, AtomicPtr, AtomicU64, AtomicUsize, Backoff, Ordering, PARK_AFTER, fence, thread,
};
use crate::pool::sync::{Mutex, lock};

/// Number of workers that each thread wakes.
const WAKES: usize = 3;

/// Threads that wait for calls. They exit when this is dropped.
#[derive(Debug)]
pub(super) struct Workers {
    shared: Arc<Shared>,
    /// Held during a call, so that callers take turns.
    turn: Mutex<()>,
}

/// A function of the thread's number, borrowed for one call.
type Task = &'static (dyn Fn(usize) + Sync);

/// State shared by the caller and its workers. Fields that different threads write lie on separate cache lines.
struct Shared {
    /// Generation counter of calls: incremented when a call opens and when it closes, so odd while workers may join.
    generation: CachePadded<AtomicU64>,
    /// Number of the last worker that may join the open call.
    helpers: AtomicUsize,
    /// The open call's task; valid while a worker has joined.
    task: AtomicPtr<Task>,
    /// For each worker, whether it has joined a call and not finished, or is about to find the call closed.
    joined: Vec<CachePadded<AtomicBool>>,
    unparkers: Vec<Unparker>,
    panic: Mutex<Option<Box<dyn Any + Send>>>,
    stop: AtomicBool,
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared")
            .field("generation", &self.generation)
            .field("joined", &self.joined)
            .finish_non_exhaustive()
    }
}

impl Workers {
    /// Starts `count` workers, numbered from 1.
    pub(super) fn new(count: usize) -> std::io::Result<Self> {
        let parkers: Vec<Parker> = (0..count).map(|_| Parker::new()).collect();
        let shared = Arc::new(Shared {
            generation: CachePadded::default(),
            helpers: AtomicUsize::new(0),
            task: AtomicPtr::new(std::ptr::null_mut()),
            joined: parkers.iter().map(|_| CachePadded::default()).collect(),
            unparkers: parkers.iter().map(|parker| parker.unparker().clone()).collect(),
            panic: Mutex::default(),
            stop: AtomicBool::new(false),
        });
        let workers = Workers { shared, turn: Mutex::default() };
        for (number, parker) in (1..).zip(parkers) {
            let shared = Arc::clone(&workers.shared);
            let name = format!("endless-worker-{number}");
            thread::Builder::new().name(name).spawn(move || shared.serve(number, &parker))?;
        }
        Ok(workers)
    }

    /// Number of workers.
    pub(super) fn count(&self) -> usize {
        self.shared.joined.len()
    }

    /// See [`Threads::run`](super::Threads::run).
    pub(super) fn run(&self, helpers: usize, work: &(dyn Fn(usize) + Sync)) {
        let _turn = lock(&self.turn);
        // SAFETY: only the lifetime changes. Workers copy the reference only after they have joined an open call. Dropping
        // `Call` closes the call and waits for all workers that have joined, before this function returns or unwinds.
        let mut task = unsafe { std::mem::transmute::<&(dyn Fn(usize) + Sync), Task>(work) };
        let call = Call::open(&self.shared, &mut task, helpers.min(self.count()));
        self.shared.wake(0, call.helpers);
        work(0);
        drop(call);
        if let Some(panic) = lock(&self.shared.panic).take() {
            resume_unwind(panic);
        }
    }
}

/// The workers exit on their own and are not joined: in the child of a fork they do not exist.
impl Drop for Workers {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::SeqCst);
        self.shared.unparkers.iter().for_each(Unparker::unpark);
    }
}

/// A call that workers may join until it is dropped.
struct Call<'a> {
    shared: &'a Shared,
    helpers: usize,
}

impl<'a> Call<'a> {
    fn open(shared: &'a Shared, task: &'a mut Task, helpers: usize) -> Self {
        // An earlier call's panic is still here if its caller panicked as well.
        *lock(&shared.panic) = None;
        shared.helpers.store(helpers, Ordering::Release);
        shared.task.store(task, Ordering::Release);
        shared.generation.fetch_add(1, Ordering::SeqCst);
        Call { shared, helpers }
    }
}

impl Drop for Call<'_> {
    fn drop(&mut self) {
        self.shared.generation.fetch_add(1, Ordering::SeqCst);
        // Either this thread sees the worker's flag, or the worker sees that the call is closed: see `join`.
        fence(Ordering::SeqCst);
        for joined in &self.shared.joined[..self.helpers] {
            let backoff = Backoff::new();
            while joined.load(Ordering::Acquire) {
                backoff.snooze();
            }
        }
    }
}

/// A worker's flag, cleared on drop.
struct Joined<'a>(&'a AtomicBool);

impl Drop for Joined<'_> {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Release);
    }
}

impl Shared {
    /// The loop of worker `number`.
    fn serve(&self, number: usize, parker: &Parker) {
        let (mut last, mut since) = (0, Instant::now());
        while let Some(generation) = self.next_call(last, since, parker) {
            last = generation;
            let helpers = self.helpers.load(Ordering::Acquire);
            if number > helpers {
                continue;
            }
            if let Some((task, _joined)) = self.join(number, generation) {
                self.wake(number, helpers);
                if let Err(panic) = catch_unwind(AssertUnwindSafe(|| task(number))) {
                    *lock(&self.panic) = Some(panic);
                }
            }
            since = Instant::now();
        }
    }

    /// Wakes this thread's share of the workers that may join.
    fn wake(&self, number: usize, helpers: usize) {
        let first = (number * WAKES).min(helpers);
        self.unparkers[first..(first + WAKES).min(helpers)].iter().for_each(Unparker::unpark);
    }

    /// Waits for a call other than `last` and returns its generation; `None` after `stop`. The worker parks when [`PARK_AFTER`]
    /// has passed since `since`, its last call.
    fn next_call(&self, last: u64, since: Instant, parker: &Parker) -> Option<u64> {
        let backoff = Backoff::new();
        while !self.stop.load(Ordering::SeqCst) {
            let generation = self.generation.load(Ordering::SeqCst);
            if generation % 2 == 1 && generation != last {
                return Some(generation);
            }
            if since.elapsed() < PARK_AFTER {
                backoff.snooze();
            } else {
                parker.park();
            }
        }
        None
    }

    /// Joins the call of that generation and returns its task, if the call is still open.
    fn join(&self, number: usize, generation: u64) -> Option<(Task, Joined<'_>)> {
        let flag = &self.joined[number - 1];
        flag.store(true, Ordering::Relaxed);
        let joined = Joined(flag);
        fence(Ordering::SeqCst);
        if self.generation.load(Ordering::Relaxed) != generation {
            return None;
        }
        // SAFETY: the call is open, and the caller that closes it sees the flag after its own fence. So it waits for this
        // worker, and until then the task stays in its stack frame.
        let task = unsafe { *self.task.load(Ordering::Acquire) };
        Some((task, joined))
    }
}

#[cfg(all(test, loom))]
mod loom_tests;

#[cfg(all(test, not(loom)))]
mod tests {
    use std::collections::HashSet;
    use std::sync::Barrier;
    use std::time::Duration;

    use super::*;
    use crate::pool::Threads;

    #[test]
    fn all_work_is_done_on_return_and_no_thread_runs_twice() {
        let threads = Threads::new(4).unwrap();
        for round in 0..2_000 {
            let left = Mutex::new((0..64).collect::<Vec<usize>>());
            let done = Mutex::new(Vec::new());
            let callers = Mutex::new(Vec::new());
            threads.run(2, &|number| {
                lock(&callers).push(number);
                while let Some(next) = { lock(&left).pop() } {
                    std::hint::black_box((0..500).sum::<usize>());
                    lock(&done).push(next);
                }
            });
            let mut done = done.into_inner().unwrap();
            done.sort_unstable();
            assert_eq!(done, (0..64).collect::<Vec<_>>(), "round {round}");
            let callers = callers.into_inner().unwrap();
            assert_eq!(callers.iter().collect::<HashSet<_>>().len(), callers.len(), "{callers:?}");
            assert!(callers.contains(&0), "{callers:?}");
            assert!(callers.iter().all(|number| *number < 3), "{callers:?}");
        }
    }

    #[test]
    fn parked_workers_wake_up() {
        let threads = Threads::new(2).unwrap();
        for _ in 0..5 {
            thread::sleep(PARK_AFTER * 20);
            let came = AtomicBool::new(false);
            threads.run(1, &|number| match number {
                0 => {
                    let start = Instant::now();
                    while !came.load(Ordering::SeqCst) && start.elapsed() < Duration::from_secs(30) {
                        thread::yield_now();
                    }
                }
                _ => came.store(true, Ordering::SeqCst),
            });
            assert!(came.into_inner());
        }
    }

    #[test]
    fn callers_take_turns() {
        let threads = Threads::new(3).unwrap();
        let occupied = AtomicBool::new(false);
        let start = Barrier::new(4);
        thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    start.wait();
                    for _ in 0..500 {
                        threads.run(2, &|number| {
                            if number == 0 {
                                assert!(!occupied.swap(true, Ordering::SeqCst), "two callers at once");
                                thread::yield_now();
                                occupied.store(false, Ordering::SeqCst);
                            }
                        });
                    }
                });
            }
        });
    }

    #[test]
    fn a_panic_reaches_the_caller_and_the_next_call_works() {
        let threads = Threads::new(2).unwrap();
        for culprits in [vec![0], vec![1], vec![0, 1]] {
            let here = AtomicBool::new(false);
            let start = Instant::now();
            let outcome = catch_unwind(AssertUnwindSafe(|| {
                threads.run(1, &|number| {
                    here.fetch_or(number == 1, Ordering::SeqCst);
                    while !here.load(Ordering::SeqCst) && start.elapsed() < Duration::from_secs(30) {
                        thread::yield_now();
                    }
                    assert!(!culprits.contains(&number), "by {number}");
                });
            }));
            let panic = outcome.unwrap_err();
            assert_eq!(panic.downcast_ref::<String>(), Some(&format!("by {}", culprits[0])));
        }
        let calls = AtomicUsize::new(0);
        threads.run(1, &|_| {
            calls.fetch_add(1, Ordering::Relaxed);
        });
        assert!(calls.into_inner() >= 1);
    }
}
