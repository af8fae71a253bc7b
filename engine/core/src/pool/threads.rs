//! Worker threads that join the calling thread in a step.
//!
//! A step takes tens of microseconds, less than it takes to wake a thread. So the caller begins at once and waits for nobody who
//! has not begun: a worker that is awake joins in, one that wakes up too late finds the work closed. Workers stay awake for a
//! while after a call, since the next one usually follows soon; then they sleep and cost nothing.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, Thread};
use std::time::{Duration, Instant};

use super::PoolError;

/// A worker looks for the next call without pause for so long, lets others run in between for as long as most trainers take
/// between two steps, and then sleeps.
const SPIN: Duration = Duration::from_micros(3);
const YIELD: Duration = Duration::from_millis(3);

/// Threads that step environments. Several pools may share them; they then take turns.
#[derive(Clone, Debug)]
pub struct Threads(Option<Arc<Workers>>);

impl Threads {
    /// `count` threads, the one that calls included; 0 stands for one for each core.
    pub fn new(count: usize) -> Result<Self, PoolError> {
        let count = if count == 0 { thread::available_parallelism().map_or(1, usize::from) } else { count };
        let workers = (count > 1).then(|| Workers::new(count - 1)).transpose();
        let workers = workers.map_err(|source| PoolError::Threads { count, source })?;
        Ok(Threads(workers.map(Arc::new)))
    }

    /// Threads that step environments at the same time.
    pub fn count(&self) -> usize {
        1 + self.0.as_ref().map_or(0, |workers| workers.threads.len())
    }

    /// Calls `work` with 0 in this thread and, at the same time, with 1 to `helpers` at most in those workers that are awake in
    /// time; returns when all calls have. A panic in any of them goes on here.
    pub(super) fn run(&self, helpers: usize, work: &(dyn Fn(usize) + Sync)) {
        match &self.0 {
            Some(workers) if helpers > 0 => workers.run(helpers, work),
            _ => work(0),
        }
    }
}

#[derive(Debug)]
struct Workers {
    shared: Arc<Shared>,
    threads: Vec<Thread>,
    /// Held during a call.
    turn: Mutex<()>,
}

/// What is called with a thread's number. It lives as long as the call lasts.
type Task = &'static (dyn Fn(usize) + Sync);

#[derive(Default)]
struct Shared {
    /// Goes up when a call opens and when it closes: odd while workers may join.
    call: AtomicU64,
    /// The last worker that may join.
    helpers: AtomicUsize,
    /// What workers join in.
    open: Mutex<Option<Task>>,
    /// Workers that have joined and are not done.
    inside: AtomicUsize,
    panic: Mutex<Option<Box<dyn Any + Send>>>,
    stop: AtomicBool,
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared").field("call", &self.call).field("inside", &self.inside).finish_non_exhaustive()
    }
}

impl Workers {
    fn new(count: usize) -> std::io::Result<Self> {
        let mut workers = Workers { shared: Arc::default(), threads: Vec::new(), turn: Mutex::default() };
        for number in 1..=count {
            let shared = Arc::clone(&workers.shared);
            let name = format!("endless-worker-{number}");
            let handle = thread::Builder::new().name(name).spawn(move || shared.serve(number))?;
            workers.threads.push(handle.thread().clone());
        }
        Ok(workers)
    }

    fn run(&self, helpers: usize, work: &(dyn Fn(usize) + Sync)) {
        let _turn = lock(&self.turn);
        // SAFETY: only the lifetime changes. Workers find the reference in `open` alone and count themselves as inside before
        // they let go of its lock; `Call` closes it and waits until none is inside before this function returns or unwinds.
        let task = unsafe { std::mem::transmute::<&(dyn Fn(usize) + Sync), Task>(work) };
        let call = Call::open(&self.shared, task, helpers);
        self.threads.iter().take(helpers).for_each(Thread::unpark);
        work(0);
        drop(call);
        if let Some(panic) = lock(&self.shared.panic).take() {
            resume_unwind(panic);
        }
    }
}

/// The workers go on their own. They are not waited for: in a process that was forked from the caller's they are not there.
impl Drop for Workers {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::SeqCst);
        self.threads.iter().for_each(Thread::unpark);
    }
}

/// A call that workers may join until it is dropped.
struct Call<'a>(&'a Shared);

impl<'a> Call<'a> {
    fn open(shared: &'a Shared, task: Task, helpers: usize) -> Self {
        // Left where the caller of an earlier call panicked too.
        *lock(&shared.panic) = None;
        shared.helpers.store(helpers, Ordering::SeqCst);
        *lock(&shared.open) = Some(task);
        shared.call.fetch_add(1, Ordering::SeqCst);
        Call(shared)
    }
}

impl Drop for Call<'_> {
    fn drop(&mut self) {
        self.0.call.fetch_add(1, Ordering::SeqCst);
        *lock(&self.0.open) = None;
        let start = Instant::now();
        while self.0.inside.load(Ordering::Acquire) > 0 {
            if start.elapsed() < SPIN { std::hint::spin_loop() } else { thread::yield_now() }
        }
    }
}

/// A worker that has joined a call.
struct Inside<'a>(&'a Shared);

impl Drop for Inside<'_> {
    fn drop(&mut self) {
        self.0.inside.fetch_sub(1, Ordering::Release);
    }
}

impl Shared {
    /// What a worker does.
    fn serve(&self, number: usize) {
        let (mut last, mut since) = (0, Instant::now());
        while let Some(call) = self.next_call(last, since) {
            last = call;
            if number > self.helpers.load(Ordering::SeqCst) {
                continue;
            }
            if let Some((task, _inside)) = self.join(call)
                && let Err(panic) = catch_unwind(AssertUnwindSafe(|| task(number)))
            {
                *lock(&self.panic) = Some(panic);
            }
            since = Instant::now();
        }
    }

    /// Waits for a call after number `last`, and returns its number; `None` when there will be no more. How long it stays awake
    /// is counted from `since`, when the worker last was wanted.
    fn next_call(&self, last: u64, since: Instant) -> Option<u64> {
        while !self.stop.load(Ordering::SeqCst) {
            let call = self.call.load(Ordering::SeqCst);
            if call % 2 == 1 && call != last {
                return Some(call);
            }
            match since.elapsed() {
                waited if waited < SPIN => std::hint::spin_loop(),
                waited if waited < YIELD => thread::yield_now(),
                _ => thread::park(),
            }
        }
        None
    }

    /// The task of a call, if it still is open; the worker then is inside.
    fn join(&self, call: u64) -> Option<(Task, Inside<'_>)> {
        let open = lock(&self.open);
        let task = open.filter(|_| self.call.load(Ordering::SeqCst) == call)?;
        self.inside.fetch_add(1, Ordering::Relaxed);
        Some((task, Inside(self)))
    }
}

/// Nothing is done under these locks that could leave what they guard half done.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn all_is_done_when_it_returns_and_no_thread_comes_twice() {
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
    fn workers_that_sleep_wake_up() {
        let threads = Threads::new(2).unwrap();
        for _ in 0..5 {
            thread::sleep(YIELD * 20);
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
        let total = AtomicUsize::new(0);
        thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..500 {
                        let mine = AtomicUsize::new(0);
                        threads.run(2, &|number| {
                            mine.fetch_add(1 + number, Ordering::Relaxed);
                        });
                        total.fetch_add(usize::from((1..=6).contains(&mine.into_inner())), Ordering::Relaxed);
                    }
                });
            }
        });
        assert_eq!(total.into_inner(), 2_000);
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
