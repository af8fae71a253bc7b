//! The last frames of an episode, for observations of several frames.

use std::collections::VecDeque;

/// The scenes of the last frames of an episode, oldest first. Nothing is kept for observations of one frame.
#[derive(Clone, Debug)]
pub(super) struct FrameStack<S> {
    scenes: VecDeque<S>,
    length: usize,
}

impl<S: Clone> FrameStack<S> {
    /// A stack for observations of `length` frames.
    pub fn new(length: usize) -> Self {
        FrameStack { scenes: VecDeque::with_capacity(length), length }
    }

    /// Frames in an observation.
    pub fn length(&self) -> usize {
        self.length
    }

    /// Fills the stack with the first scene of an episode.
    pub fn restart(&mut self, scene: impl FnOnce() -> S) {
        self.scenes.clear();
        if self.length > 1 {
            self.scenes.resize(self.length, scene());
        }
    }

    /// Replaces the oldest scene by a new one.
    pub fn push(&mut self, scene: impl FnOnce() -> S) {
        if self.length > 1 {
            self.scenes.pop_front();
            self.scenes.push_back(scene());
        }
    }

    /// The scenes of the observation's frames, oldest first. `last` returns the newest one, which an observation of one frame
    /// has.
    pub fn scenes(&self, last: impl FnOnce() -> S) -> impl Iterator<Item = S> {
        let last = (self.length == 1).then(last);
        self.scenes.iter().cloned().chain(last)
    }
}
