//! One observed group of an engine, and which of its batches are taken.
//!
//! An active observer keeps the newest batch in its queue, so the engine must write each batch to other memory than the
//! previous one, which takes up to twice as long. While the engine is busy, the observer is therefore paused as soon as
//! a newer batch follows the one shown, and resumes when the next frame is due. The newest batch is held until another
//! follows, so that browsers can select any of its environments while the trainer pauses.

use std::thread;
use std::time::{Duration, Instant};

use endless_gym_core::batch::Block;
use endless_gym_service::{BatchLease, Observer, ServiceError};

/// Time between two frames for a browser, and so between two batches that are taken.
const FRAME_INTERVAL: Duration = Duration::from_millis(33);

/// The shortest such time while the engine is busy, since resuming creates files and mappings.
const BUSY_FRAME_INTERVAL: Duration = Duration::from_millis(100);

/// The same per megabyte of a batch: for each frame, the engine writes two batches to memory that is not in its cache,
/// which takes about 75 microseconds longer per megabyte.
const BUSY_INTERVAL_OF_A_MEGABYTE: Duration = Duration::from_millis(10);

/// An engine that returns at least this many batches per second is busy.
const BUSY_RATE: f64 = 60.0;

/// The same while no browser shows the group, when hardly any batch is taken.
const BUSY_RATE_HIDDEN: f64 = 2.0;

/// An engine without a batch for this time is not busy.
const IDLE_AFTER: Duration = Duration::from_millis(250);

/// The first and the longest sleep while waiting for the next batch after a pause. The total wait is about twice the
/// longest.
const SHORTEST_NAP: Duration = Duration::from_micros(100);
const LONGEST_NAP: Duration = Duration::from_millis(3);

/// A group and its newest batch.
pub(crate) struct WatchedGroup {
    observer: Observer,
    /// Time between two frames while the engine is busy.
    busy_interval: Duration,
    /// The newest batch, if it is held.
    newest: Option<BatchLease>,
    /// The number and the time of the last batch that was taken.
    last: (u64, Instant),
    /// Whether a batch is to be taken.
    is_wanted: bool,
    /// Whether a browser shows this group, not only its curves.
    is_shown: bool,
    /// Whether the engine returned batches at a high rate before the last one that was taken.
    is_busy: bool,
}

impl WatchedGroup {
    pub fn new(mut observer: Observer) -> Self {
        // Paused until a browser wants a frame: an open port keeps the engine from reusing its buffer.
        observer.pause();
        let last = (observer.step().unwrap_or(0), Instant::now());
        let megabytes = (observer.specification().batch.blocks() * size_of::<Block>()) as f64 / 1e6;
        let busy_interval = BUSY_INTERVAL_OF_A_MEGABYTE.mul_f64(megabytes).max(BUSY_FRAME_INTERVAL);
        WatchedGroup { observer, busy_interval, newest: None, last, is_wanted: true, is_shown: true, is_busy: false }
    }

    /// Requests the next batch, for a browser that shows the group or only for its curves. Ignored until the next frame
    /// is due.
    pub fn want(&mut self, is_shown: bool) {
        let interval = if self.is_busy { self.busy_interval } else { FRAME_INTERVAL };
        if self.last.1.elapsed() >= interval {
            (self.is_wanted, self.is_shown) = (true, is_shown);
        }
    }

    /// Whether the engine has written batches since the last one that was taken.
    fn is_followed(&self) -> bool {
        self.observer.step().map_or_else(|| self.observer.has_newer(), |step| step > self.last.0)
    }

    /// Replaces the held batch with the newest one, if one is wanted and there is one. Returns whether there was one.
    pub fn take(&mut self) -> Result<bool, ServiceError> {
        if !self.is_wanted || !self.is_followed() {
            return Ok(false);
        }
        // Dropped first, since the engine may permit only one lease.
        self.newest = None;
        self.newest = self.received()?;
        let Some(lease) = &self.newest else { return Ok(false) };
        let (step, time) = std::mem::replace(&mut self.last, (lease.step(), Instant::now()));
        let batches = lease.step().saturating_sub(step) as f64;
        let busy_rate = if self.is_shown { BUSY_RATE } else { BUSY_RATE_HIDDEN };
        self.is_busy = batches >= busy_rate * time.elapsed().as_secs_f64();
        self.is_wanted = false;
        Ok(true)
    }

    /// The newest batch. Waits for it after a pause, so that the queue does not hold it longer than necessary.
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

    /// Releases the batch if newer ones follow it.
    pub fn release(&mut self) {
        if self.newest.is_some() && self.is_followed() {
            self.newest = None;
            if self.is_busy {
                self.observer.pause();
            }
        }
        self.is_busy &= self.last.1.elapsed() < IDLE_AFTER;
    }

    /// Whether the observer keeps a busy engine from reusing its memory.
    pub fn is_urgent(&self) -> bool {
        self.is_busy && !self.observer.is_paused()
    }

    pub fn observer(&self) -> &Observer {
        &self.observer
    }

    /// The newest batch, if it is held.
    pub fn newest(&self) -> Option<&BatchLease> {
        self.newest.as_ref()
    }
}
