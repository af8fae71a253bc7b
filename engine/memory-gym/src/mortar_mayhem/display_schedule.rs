//! The schedule for showing commands.

use serde::{Deserialize, Serialize};

use super::parameters::MAX_DURATION;

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

    /// Whether it can be a schedule of a sequence of so many commands. A forged snapshot may hold any numbers.
    pub fn is_valid(&self, commands: usize) -> bool {
        let most = MAX_DURATION as usize;
        let period = self.duration.saturating_add(self.delay);
        let count = self.frames.checked_div(period).unwrap_or(0);
        self.duration.max(self.delay) <= most
            && self.frames == count * period
            && self.first.checked_add(count).is_some_and(|end| end <= commands)
            // Each view of the ground truth advances its schedule.
            && self.frame <= u32::MAX as usize
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
