//! Episodes and speed of an engine over time.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use endless_gym_core::batch::Batch;
use endless_gym_service::EngineStatus;
use serde::Serialize;

/// Number of episodes over which the return and the length are averaged.
const WINDOW: usize = 1000;

/// Maximum number of points kept, one per second.
const MAX_POINTS: usize = 3600;

/// Time over which steps per second are averaged, so that a trainer's pauses for learning do not appear as drops to 0.
const RATE_WINDOW: Duration = Duration::from_secs(10);

/// The statistics of an engine at one time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(crate) struct Point {
    /// Seconds since the engine started.
    pub seconds: f64,
    /// Environment steps per second over the last 10 seconds, or since the observation began.
    pub steps_per_second: f64,
    /// Episodes that have ended since the engine started.
    pub episodes: u64,
    /// Means over the last episodes that ended while somebody watched: [`WINDOW`] or a few more, or all if there are fewer. Over all
    /// episodes of the engine if these are at most [`WINDOW`], or if none ended while somebody watched. `None` before the first.
    pub mean_return: Option<f64>,
    pub mean_length: Option<f64>,
    pub success_rate: Option<f64>,
}

/// Sums over the episodes that have ended, at one time.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    episodes: u64,
    returns: f64,
    lengths: u64,
    successes: u64,
}

impl Sums {
    fn of(status: &EngineStatus) -> Self {
        Sums {
            episodes: status.total(|group| group.episodes),
            returns: status.groups.iter().map(|group| group.returns).sum(),
            lengths: status.total(|group| group.lengths),
            successes: status.total(|group| group.successes),
        }
    }
}

/// The returns and lengths of the last episodes that ended in the given batches.
#[derive(Debug, Default)]
pub struct RecentEpisodes {
    results: VecDeque<(f64, i32)>,
    /// Episodes that have ended in all batches.
    pub ended: u64,
}

impl RecentEpisodes {
    /// Adds the episodes that have ended in a batch.
    pub fn add(&mut self, batch: &Batch<'_>) {
        let ended = batch.terminated().iter().zip(batch.truncated()).map(|(a, b)| a | b);
        let results = batch.episode_return().iter().zip(batch.episode_length());
        for (_, (total, length)) in ended.zip(results).filter(|(ended, _)| *ended != 0) {
            self.ended += 1;
            if self.results.len() == WINDOW {
                self.results.pop_front();
            }
            self.results.push_back((*total, *length));
        }
    }

    /// Mean return and mean length of the last 1,000 episodes, or of all if there are fewer; `None` before the first.
    pub fn means(&self) -> Option<(f64, f64)> {
        let count = self.results.len() as f64;
        let sum = |value: fn(&(f64, i32)) -> f64| self.results.iter().map(value).sum::<f64>();
        (count > 0.0).then(|| (sum(|result| result.0) / count, sum(|result| f64::from(result.1)) / count))
    }
}

/// Counts per second over the last 10 seconds.
#[derive(Debug, Default)]
pub struct RecentRate {
    /// Counts in the window, and the last one before it.
    counts: VecDeque<(Instant, u64)>,
}

impl RecentRate {
    /// Adds the count at a time, and returns the rate since the beginning of the window or the first count; `None` for the first.
    pub fn add(&mut self, now: Instant, count: u64) -> Option<f64> {
        self.counts.push_back((now, count));
        while self.counts.get(1).is_some_and(|(time, _)| now - *time >= RATE_WINDOW) {
            self.counts.pop_front();
        }
        let (begin, before) = *self.counts.front().filter(|_| self.counts.len() > 1)?;
        Some(count.saturating_sub(before) as f64 / (now - begin).as_secs_f64().max(1e-3))
    }
}

/// The points of one run of an engine.
#[derive(Debug, Default)]
pub(crate) struct History {
    /// Identifies the run of the engine.
    pub incarnation: u64,
    /// Points that were dropped from the front.
    dropped: u64,
    points: VecDeque<Point>,
    rate: RecentRate,
    /// The last sums before the episodes of the means, and those since.
    sums: VecDeque<Sums>,
}

impl History {
    /// Starts a new history if it is another run of the engine.
    pub fn begin(&mut self, incarnation: u64) {
        if self.incarnation != incarnation {
            *self = History { incarnation, ..History::default() };
        }
        // Rates must not include the time without observation.
        self.rate = RecentRate::default();
    }

    /// Adds a point; `has_success` says whether episodes end with an info `success`. The first status gives none, since a rate needs two.
    pub fn point(&mut self, status: &EngineStatus, has_success: bool) {
        let steps = status.total(|group| group.env_steps);
        let Some(steps_per_second) = self.rate.add(Instant::now(), steps) else { return };
        let sums = Sums::of(status);
        let first = self.recent(sums);
        let mean = |sum: f64| (sums.episodes > first.episodes).then(|| sum / (sums.episodes - first.episodes) as f64);
        let point = Point {
            seconds: status.uptime.as_secs_f64(),
            steps_per_second,
            episodes: sums.episodes,
            mean_return: mean(sums.returns - first.returns),
            mean_length: mean(sums.lengths.saturating_sub(first.lengths) as f64),
            success_rate: mean(sums.successes.saturating_sub(first.successes) as f64).filter(|_| has_success),
        };
        if self.points.len() == MAX_POINTS {
            self.points.pop_front();
            self.dropped += 1;
        }
        self.points.push_back(point);
    }

    /// Keeps the sums, and returns those before the last episodes.
    fn recent(&mut self, sums: Sums) -> Sums {
        if self.sums.back().is_none_or(|last| last.episodes < sums.episodes) {
            self.sums.push_back(sums);
        }
        while self.sums.get(1).is_some_and(|next| next.episodes + WINDOW as u64 <= sums.episodes) {
            self.sums.pop_front();
        }
        // All episodes of the engine, if there are few, or none was watched.
        let is_recent = |first: &Sums| sums.episodes > WINDOW as u64 && first.episodes < sums.episodes;
        self.sums.front().copied().filter(is_recent).unwrap_or_default()
    }

    /// The points from number `from` on, and the number after the last.
    pub fn since(&self, from: u64) -> (Vec<Point>, u64) {
        let skipped = usize::try_from(from.saturating_sub(self.dropped)).unwrap_or(usize::MAX);
        (self.points.iter().skip(skipped).copied().collect(), self.dropped + self.points.len() as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_of_all_episodes_at_first_and_then_of_the_last_ones() {
        let mut history = History::default();
        let sums = |episodes: u64, returns: f64| Sums { episodes, returns, ..Sums::default() };
        // All end in the same step, between two readings.
        assert_eq!(history.recent(sums(0, 0.0)).episodes, 0);
        assert_eq!(history.recent(sums(400, 100.0)).returns, 0.0);
        assert_eq!(history.recent(sums(800, 150.0)).returns, 0.0);
        assert_eq!(history.recent(sums(1400, 900.0)).returns, 100.0);
        assert_eq!(history.recent(sums(1800, 1000.0)).returns, 150.0);
    }

    #[test]
    fn rates_are_averaged_over_phases_without_steps_and_fall_to_zero_after_the_last() {
        let (start, mut rate) = (Instant::now(), RecentRate::default());
        assert_eq!(rate.add(start, 0), None);
        // 1,000 steps a second in phases of two seconds, with two seconds of learning between them.
        let (mut steps, mut rates) = (0, Vec::new());
        for second in 1..=40 {
            steps += if second % 4 < 2 { 1000 } else { 0 };
            rates.extend(rate.add(start + Duration::from_secs(second), steps));
        }
        assert!(rates[10..].iter().all(|rate| (400.0..=600.0).contains(rate)), "{rates:?}");
        let last = (41..=60).filter_map(|second| rate.add(start + Duration::from_secs(second), steps)).last();
        assert_eq!(last, Some(0.0));
    }
}
