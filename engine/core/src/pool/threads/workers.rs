//! Worker threads that join the calling thread in a step.
//!
//! A step takes tens of microseconds, less than waking a thread. So the caller starts at once and waits only for workers that
//! have joined: a running worker joins, and one that wakes too late finds the call closed. After a call, a worker spins, then
//! yields, then parks.
//!
//! To scale to many workers, each joins by its own flag and wakes a few others, which wake others in turn. What all of them poll and
//! read at the start of a call is on one cache line, to which the caller writes once for a call.

use std::any::Any;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::time::Duration;

use crossbeam_utils::CachePadded;
use crossbeam_utils::sync::{Parker, Unparker};

use super::shares::Shares;
use super::step_times::StepTimes;
use super::times::Times;
use crate::pool::sync::threads::{
    Arc, AtomicBool, AtomicPtr, AtomicU64, AtomicUsize, Ordering, PARK_AFTER, Wait, fence, thread,
};
use crate::pool::sync::{Mutex, lock};

/// Number of workers that each thread wakes.
const WAKES: usize = 3;

/// How long a thread spins before it yields.
const SPIN: Duration = Duration::from_micros(3);

/// How long it spins in a rollout whose calls follow each other within this time.
const LONG_SPIN: Duration = Duration::from_micros(50);

/// Calls within [`LONG_SPIN`] after which a worker expects the next one as soon. Where another thread needs the core before it can
/// call, such as the trainer of an engine with as many threads as cores, so few long spins are in vain that they cost nothing.
const QUICK_CALLS: u32 = 64;

/// How long [`Workers::on_each`] waits for a worker. In the child of a fork there are none.
const PATIENCE: Duration = Duration::from_secs(10);

/// The generation after the last call.
const STOPPED: u64 = u64::MAX;

/// Threads that wait for calls. They exit when this is dropped.
#[derive(Debug)]
pub(super) struct Workers {
    shared: Arc<Shared>,
    /// Held during a call, so that callers take turns.
    turn: Mutex<Turn>,
}

/// Sets a flag when it is dropped.
struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
    }
}

/// What belongs to the caller whose turn it is.
#[derive(Debug)]
struct Turn {
    shares: Shares,
    times: Option<Times>,
}

/// A function of the thread's number, borrowed for one call.
type Task = &'static (dyn Fn(usize) + Sync);

/// State shared by the caller and its workers. Fields that different threads write lie on separate cache lines.
struct Shared {
    call: CachePadded<OpenCall>,
    /// For each worker, whether it has joined a call and not finished, or is about to find the call closed.
    joined: Vec<CachePadded<AtomicBool>>,
    unparkers: Vec<Unparker>,
    panic: CachePadded<Mutex<Option<Box<dyn Any + Send>>>>,
    /// Whether each thread can have a core, so that a long spin takes none from another.
    may_spin: bool,
}

/// What the caller tells the workers.
#[derive(Default)]
struct OpenCall {
    /// Generation counter of calls: incremented when a call opens and when it closes, so odd while workers may join; [`STOPPED`]
    /// when there will be none.
    generation: AtomicU64,
    /// Number of the last worker that may join the open call.
    helpers: AtomicUsize,
    /// The open call's task; valid while a worker has joined.
    task: AtomicPtr<Task>,
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared")
            .field("generation", &self.call.generation)
            .field("joined", &self.joined)
            .finish_non_exhaustive()
    }
}

impl Workers {
    /// Starts `count` workers, numbered from 1.
    pub(super) fn new(count: usize, may_spin: bool, timed: bool) -> std::io::Result<Self> {
        let parkers: Vec<Parker> = (0..count).map(|_| Parker::new()).collect();
        let shared = Arc::new(Shared {
            call: CachePadded::default(),
            joined: parkers.iter().map(|_| CachePadded::default()).collect(),
            unparkers: parkers.iter().map(|parker| parker.unparker().clone()).collect(),
            panic: CachePadded::default(),
            may_spin,
        });
        let turn = Turn { shares: Shares::new(1 + count), times: timed.then(|| Times::new(1 + count)) };
        let workers = Workers { shared, turn: Mutex::new(turn) };
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

    /// See [`Threads::take_times`](super::Threads::take_times).
    pub(super) fn take_times(&self) -> Option<StepTimes> {
        lock(&self.turn).times.as_mut().map(Times::take)
    }

    /// See [`Threads::on_each`](super::Threads::on_each).
    pub(super) fn on_each(&self, count: usize, work: &(dyn Fn(usize) + Sync)) {
        let _turn = lock(&self.turn);
        let done: Vec<AtomicBool> = (0..count).map(|_| AtomicBool::new(false)).collect();
        let left =
            || done.iter().enumerate().filter(|(_, done)| !done.load(Ordering::Acquire)).map(|(thread, _)| thread);
        self.shared.call(count - 1, &|thread| {
            {
                // Also if `work` panics, which resumes in the caller.
                let _done = SetOnDrop(&done[thread]);
                work(thread);
            }
            let mut wait = Wait::new(SPIN);
            while thread == 0 && wait.waited() < PATIENCE && left().next().is_some() {
                wait.pause();
            }
        });
        left().for_each(work);
    }

    /// A call of `work` without shares.
    #[cfg(test)]
    fn run(&self, helpers: usize, work: &(dyn Fn(usize) + Sync)) {
        let _turn = lock(&self.turn);
        self.shared.call(helpers, work);
    }

    /// See [`Threads::for_each_piece`](super::Threads::for_each_piece).
    pub(super) fn for_each_piece(&self, items: usize, count: usize, work: &(dyn Fn(Range<usize>) + Sync)) {
        let mut turn = lock(&self.turn);
        let Turn { shares, times } = &mut *turn;
        let division = shares.divide(items, count);
        let work = |thread| division.for_each_piece(thread, work);
        match times {
            None => self.shared.call(count - 1, &work),
            Some(times) => times.measure(count, |work| self.shared.call(count - 1, work), work),
        }
    }
}

/// The workers exit on their own and are not joined: in the child of a fork they do not exist.
impl Drop for Workers {
    fn drop(&mut self) {
        self.shared.call.generation.store(STOPPED, Ordering::SeqCst);
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
        shared.call.helpers.store(helpers, Ordering::Release);
        shared.call.task.store(task, Ordering::Release);
        shared.call.generation.fetch_add(1, Ordering::SeqCst);
        Call { shared, helpers }
    }
}

impl Drop for Call<'_> {
    fn drop(&mut self) {
        self.shared.call.generation.fetch_add(1, Ordering::SeqCst);
        // Either this thread sees the worker's flag, or the worker sees that the call is closed: see `join`.
        fence(Ordering::SeqCst);
        for joined in &self.shared.joined[..self.helpers] {
            if joined.load(Ordering::Acquire) {
                let mut wait = Wait::new(if self.shared.may_spin { LONG_SPIN } else { SPIN });
                while joined.load(Ordering::Acquire) {
                    wait.pause();
                }
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
    /// Calls `work(0)` in this thread and, at the same time, `work(n)` for each `n` of `1..=helpers` whose worker joins before
    /// the calling thread is done. Returns when all calls have returned; a panic in any of them resumes here. One caller at a time.
    fn call(&self, helpers: usize, work: &(dyn Fn(usize) + Sync)) {
        // SAFETY: only the lifetime changes. Workers copy the reference only after they have joined an open call. Dropping
        // `Call` closes the call and waits for all workers that have joined, before this function returns or unwinds.
        let mut task = unsafe { std::mem::transmute::<&(dyn Fn(usize) + Sync), Task>(work) };
        let call = Call::open(self, &mut task, helpers.min(self.joined.len()));
        self.wake(0, call.helpers);
        work(0);
        drop(call);
        if let Some(panic) = lock(&self.panic).take() {
            resume_unwind(panic);
        }
    }

    /// The loop of worker `number`.
    fn serve(&self, number: usize, parker: &Parker) {
        let (mut last, mut quick_calls) = (0, 0);
        let mut wait = Wait::new(SPIN);
        while let Some(generation) = self.next_call(last, &mut wait, parker) {
            last = generation;
            let helpers = self.call.helpers.load(Ordering::Acquire);
            if number > helpers {
                continue;
            }
            if let Some((task, _joined)) = self.join(number, generation) {
                self.wake(number, helpers);
                if let Err(panic) = catch_unwind(AssertUnwindSafe(|| task(number))) {
                    *lock(&self.panic) = Some(panic);
                }
            }
            quick_calls = if wait.waited() < LONG_SPIN { u32::saturating_add(quick_calls, 1) } else { 0 };
            wait = Wait::new(if self.may_spin && quick_calls >= QUICK_CALLS { LONG_SPIN } else { SPIN });
        }
    }

    /// Wakes this thread's share of the workers that may join.
    fn wake(&self, number: usize, helpers: usize) {
        let first = (number * WAKES).min(helpers);
        self.unparkers[first..(first + WAKES).min(helpers)].iter().for_each(Unparker::unpark);
    }

    /// Waits for a call other than `last` and returns its generation; `None` after the last call. The worker parks when it has waited
    /// for [`PARK_AFTER`].
    fn next_call(&self, last: u64, wait: &mut Wait, parker: &Parker) -> Option<u64> {
        loop {
            match self.call.generation.load(Ordering::SeqCst) {
                STOPPED => return None,
                generation if generation % 2 == 1 && generation != last => return Some(generation),
                _ if wait.waited() < PARK_AFTER => wait.pause(),
                _ => parker.park(),
            }
        }
    }

    /// Joins the call of that generation and returns its task, if the call is still open.
    fn join(&self, number: usize, generation: u64) -> Option<(Task, Joined<'_>)> {
        let flag = &self.joined[number - 1];
        flag.store(true, Ordering::Relaxed);
        let joined = Joined(flag);
        fence(Ordering::SeqCst);
        if self.call.generation.load(Ordering::Relaxed) != generation {
            return None;
        }
        // SAFETY: the call is open, and the caller that closes it sees the flag after its own fence. So it waits for this
        // worker, and until then the task stays in its stack frame.
        let task = unsafe { *self.call.task.load(Ordering::Acquire) };
        Some((task, joined))
    }
}

#[cfg(all(test, loom))]
mod loom_tests;

#[cfg(all(test, not(loom)))]
mod tests {
    use std::collections::HashSet;
    use std::sync::Barrier;
    use std::time::Instant;

    use super::*;

    #[test]
    fn all_work_is_done_on_return_and_no_thread_runs_twice() {
        let workers = Workers::new(3, true, false).unwrap();
        for round in 0..2_000 {
            let left = Mutex::new((0..64).collect::<Vec<usize>>());
            let done = Mutex::new(Vec::new());
            let callers = Mutex::new(Vec::new());
            workers.run(2, &|number| {
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
        let workers = Workers::new(2, true, false).unwrap();
        for _ in 0..5 {
            thread::sleep(PARK_AFTER * 20);
            let callers = Mutex::new(Vec::new());
            workers.on_each(3, &|number| lock(&callers).push((number, thread::current().id())));
            let callers = callers.into_inner().unwrap();
            assert_eq!(callers.iter().map(|(number, _)| number).collect::<HashSet<_>>().len(), 3, "{callers:?}");
            assert_eq!(callers.iter().map(|(_, thread)| thread).collect::<HashSet<_>>().len(), 3, "{callers:?}");
        }
    }

    #[test]
    fn parts_of_a_call_are_within_its_time() {
        let workers = Workers::new(2, true, true).unwrap();
        let start = Instant::now();
        for _ in 0..100 {
            workers.for_each_piece(90, 3, &|piece| {
                std::hint::black_box(piece.sum::<usize>());
            });
        }
        let (elapsed, times) = (start.elapsed(), workers.take_times().unwrap());
        assert_eq!(times.steps, 100);
        assert!(times.opening + times.joining + times.working + times.waiting <= elapsed, "{times:?} in {elapsed:?}");
        assert!(times.working > Duration::ZERO && times.last_join >= times.joining, "{times:?}");
        assert_eq!(workers.take_times(), Some(StepTimes::default()));
        assert_eq!(Workers::new(1, true, false).unwrap().take_times(), None);
    }

    #[test]
    fn callers_take_turns() {
        let workers = Workers::new(2, true, false).unwrap();
        let occupied = AtomicBool::new(false);
        let start = Barrier::new(4);
        thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    start.wait();
                    for _ in 0..500 {
                        workers.run(2, &|number| {
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
        let workers = Workers::new(1, true, false).unwrap();
        for culprits in [vec![0], vec![1], vec![0, 1]] {
            let here = AtomicBool::new(false);
            let start = Instant::now();
            let outcome = catch_unwind(AssertUnwindSafe(|| {
                workers.run(1, &|number| {
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
        workers.run(1, &|_| {
            calls.fetch_add(1, Ordering::Relaxed);
        });
        assert!(calls.into_inner() >= 1);
    }
}
