//! Measures where the time of a call goes.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crossbeam_utils::CachePadded;

use super::step_times::StepTimes;

/// When a thread began and ended its work in a call, in nanoseconds since the call's start; the end is 0 if it has not.
type Span = CachePadded<(AtomicU64, AtomicU64)>;

/// The times of the calls so far, and of each thread in the current one.
#[derive(Debug)]
pub(super) struct Times {
    sum: StepTimes,
    spans: Vec<Span>,
}

impl Times {
    pub(super) fn new(threads: usize) -> Self {
        Times { sum: StepTimes::default(), spans: (0..threads).map(|_| Span::default()).collect() }
    }

    /// Measures a call of the first `count` threads: `call` calls each thread that joins with its number, and `work` is its work.
    pub(super) fn measure(
        &mut self,
        count: usize,
        call: impl FnOnce(&(dyn Fn(usize) + Sync)),
        work: impl Fn(usize) + Sync,
    ) {
        let spans = &self.spans[..count];
        spans.iter().for_each(|span| span.1.store(0, Ordering::Relaxed));
        let start = Instant::now();
        let now = || u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
        call(&|thread| {
            let began = now();
            work(thread);
            spans[thread].0.store(began, Ordering::Relaxed);
            spans[thread].1.store(now(), Ordering::Relaxed);
        });
        let end = now();
        let opened = spans[0].0.load(Ordering::Relaxed);
        let (mut joining, mut last, mut working, mut waiting) = (0, 0, 0, 0);
        for span in spans {
            let ended = span.1.load(Ordering::Relaxed);
            // A thread that has not joined.
            let (began, ended) = if ended == 0 { (end, end) } else { (span.0.load(Ordering::Relaxed), ended) };
            let began = began.max(opened);
            last = last.max(began - opened);
            joining += began - opened;
            working += ended.saturating_sub(began);
            waiting += end - ended.max(began);
        }
        let mean = |sum: u64| Duration::from_nanos(sum / count as u64);
        self.sum.steps += 1;
        self.sum.opening += Duration::from_nanos(opened);
        self.sum.joining += mean(joining);
        self.sum.last_join += Duration::from_nanos(last);
        self.sum.working += mean(working);
        self.sum.waiting += mean(waiting);
    }

    pub(super) fn take(&mut self) -> StepTimes {
        std::mem::take(&mut self.sum)
    }
}
