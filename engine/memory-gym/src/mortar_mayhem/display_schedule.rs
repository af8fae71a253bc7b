//! The schedule for showing commands.

use serde::{Deserialize, Serialize};

/// Shows part of the sequence: each command for `duration` frames, followed by `delay` frames without a command.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DisplaySchedule {
    /// Index in the sequence of the first command to show.
    first: usize,
    duration: usize,
    delay: usize,
    /// Frames that have passed, of [`frames`](Self::frames) in total.
    frame: usize,
    frames: usize,
}

impl DisplaySchedule {
    /// Shows `count` commands of the sequence, from index `first` on.
    pub fn new(first: usize, count: usize, duration: usize, delay: usize) -> Self {
        DisplaySchedule { first, duration, delay, frame: 0, frames: count * (duration + delay) }
    }

    /// Whether every number is in range. A forged snapshot may hold any numbers.
    pub fn is_valid(&self) -> bool {
        const LIMIT: u64 = 1 << 32;
        [self.first, self.duration, self.delay, self.frame, self.frames].iter().all(|number| (*number as u64) < LIMIT)
            && (self.frames == 0 || self.duration + self.delay > 0)
    }

    /// Index in the sequence of the first command to show.
    pub fn first(&self) -> usize {
        self.first
    }

    /// The schedule as it was `frames` frames ago.
    pub fn before(self, frames: usize) -> Self {
        DisplaySchedule { frame: self.frame.saturating_sub(frames), ..self }
    }

    /// Whether everything has been shown.
    pub fn is_over(&self) -> bool {
        self.frame >= self.frames
    }

    /// Advances by one frame and returns the index in the sequence of the command that it shows, if any.
    pub fn next_frame(&mut self) -> Option<usize> {
        let (frame, is_over) = (self.frame, self.is_over());
        self.frame += 1;
        let period = self.duration + self.delay;
        (!is_over && frame % period < self.duration).then(|| self.first + frame / period)
    }
}
