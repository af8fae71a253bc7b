//! Where the time of steps went.

use std::time::Duration;

/// Where the time of steps on several threads went. The sum of `opening`, `joining`, `working` and `waiting` is the time between
/// the calls of the threads and their end; what a step takes beyond it is the calling thread's alone.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StepTimes {
    /// Steps.
    pub steps: u64,
    /// Until the calling thread began to step environments, after it had called and woken the workers.
    pub opening: Duration,
    /// From then until a thread joined, as the mean over the threads.
    pub joining: Duration,
    /// From then until the last thread joined.
    pub last_join: Duration,
    /// The time in which a thread stepped environments, as the mean over the threads.
    pub working: Duration,
    /// From the end of a thread's work until all were done, as the mean over the threads.
    pub waiting: Duration,
}
