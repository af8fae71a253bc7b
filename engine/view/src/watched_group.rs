//! One group of an engine that is observed: which of its batches are taken.
//!
//! An observer that can receive keeps the newest batch in its queue. The engine must then write each batch to other memory than the
//! one before, which takes it up to twice the time. While the engine is busy, the observer is therefore paused as soon as
//! another batch follows the one that was shown, and resumes when another frame is due. The newest batch is held while
//! none follows it, so that browsers may select any of its environments while the trainer pauses.

use std::thread;
use std::time::{Duration, Instant};

use endless_gym_core::batch::{Batch, Block};
use endless_gym_service::{BatchLease, Observer, ServiceError};

/// Time between two frames that a browser gets, and so between two batches that are taken. Episodes that end in other batches are not
/// part of the means.
const FRAME_INTERVAL: Duration = Duration::from_millis(33);

/// The same while the engine is busy, at least: the end of a pause creates files and mappings.
const BUSY_FRAME_INTERVAL: Duration = Duration::from_millis(100);

/// The same for each megabyte of a batch: two batches for each frame are written to memory that is not in the engine's cache, which
/// takes about 75 microseconds longer for each of their megabytes.
const BUSY_INTERVAL_OF_A_MEGABYTE: Duration = Duration::from_millis(10);

/// An engine that returns this number of batches in a second, or more, is busy.
const BUSY_RATE: f64 = 60.0;

/// The same while no browser shows the group: then hardly any batch is taken.
const BUSY_RATE_HIDDEN: f64 = 2.0;

/// Without a batch for this time, an engine is not busy.
const IDLE_AFTER: Duration = Duration::from_millis(250);

/// How long the next batch is waited for after a pause: at first between two looks, and in all about twice the longest.
const SHORTEST_NAP: Duration = Duration::from_micros(100);
const LONGEST_NAP: Duration = Duration::from_millis(3);

/// A group and its newest batch.
pub(crate) struct WatchedGroup {
    observer: Observer,
    /// Time between two frames while the engine is busy.
    busy_interval: Duration,
    /// The newest batch, if it is held.
    newest: Option<BatchLease>,
    /// The number of the last batch that was taken, and when.
    last: (u64, Instant),
    /// A batch is to be taken.
    is_wanted: bool,
    /// A browser shows this group, not only its curves.
    is_shown: bool,
    /// The engine returned batches at a high rate before the last one that was taken.
    is_busy: bool,
}

impl WatchedGroup {
    pub fn new(mut observer: Observer) -> Self {
        // Until it is known what the browsers want: an open port keeps the engine from its one buffer.
        observer.pause();
        let last = (observer.step().unwrap_or(0), Instant::now());
        let megabytes = (observer.specification().batch.blocks() * size_of::<Block>()) as f64 / 1e6;
        let busy_interval = BUSY_INTERVAL_OF_A_MEGABYTE.mul_f64(megabytes).max(BUSY_FRAME_INTERVAL);
        WatchedGroup { observer, busy_interval, newest: None, last, is_wanted: true, is_shown: true, is_busy: false }
    }

    /// Asks for the next batch, for a browser that shows the group or only for its curves. Ignored while no other frame is due.
    pub fn want(&mut self, is_shown: bool) {
        let interval = if self.is_busy { self.busy_interval } else { FRAME_INTERVAL };
        if self.last.1.elapsed() >= interval {
            (self.is_wanted, self.is_shown) = (true, is_shown);
        }
    }

    /// Whether the engine has written other batches since the last one that was taken.
    fn is_followed(&self) -> bool {
        self.observer.step().map_or_else(|| self.observer.has_newer(), |step| step > self.last.0)
    }

    /// Takes the newest batch in place of the one before, if one is wanted and there is one.
    pub fn take(&mut self) -> Result<Option<Batch<'_>>, ServiceError> {
        if !self.is_wanted || !self.is_followed() {
            return Ok(None);
        }
        // First, since the engine may permit only one.
        self.newest = None;
        self.newest = self.received()?;
        let Some(lease) = &self.newest else { return Ok(None) };
        let (step, time) = std::mem::replace(&mut self.last, (lease.step(), Instant::now()));
        let batches = lease.step().saturating_sub(step) as f64;
        let busy_rate = if self.is_shown { BUSY_RATE } else { BUSY_RATE_HIDDEN };
        self.is_busy = batches >= busy_rate * time.elapsed().as_secs_f64();
        self.is_wanted = false;
        Ok(Some(lease.batch()))
    }

    /// The newest batch. After a pause, the next one is waited for, so that the queue does not hold it longer than necessary.
    fn received(&mut self) -> Result<Option<BatchLease>, ServiceError> {
        let was_paused = self.observer.is_paused();
        let mut batch = self.observer.newest()?;
        let mut nap = SHORTEST_NAP;
        while was_paused && batch.is_none() && nap <= LONGEST_NAP {
            thread::sleep(nap);
            nap *= 2;
            batch = self.observer.newest()?;
        }
        Ok(batch)
    }

    /// Releases the batch if others follow it.
    pub fn release(&mut self) {
        if self.newest.is_some() && self.is_followed() {
            self.newest = None;
            if self.is_busy {
                self.observer.pause();
            }
        }
        self.is_busy &= self.last.1.elapsed() < IDLE_AFTER;
    }

    /// Whether the observer keeps a busy engine from writing to the same memory.
    pub fn is_urgent(&self) -> bool {
        self.is_busy && !self.observer.is_paused()
    }

    /// The newest batch, if it is held.
    pub fn newest(&self) -> Option<&BatchLease> {
        self.newest.as_ref()
    }

    /// An error if the engine has ended.
    pub fn check_alive(&self) -> Result<(), ServiceError> {
        self.observer.check_alive()
    }
}
