//! The last frames of an episode, for observations that have several.

use std::collections::VecDeque;

/// What the last frames of an episode show, oldest first, for observations of several frames; empty for those of one.
#[derive(Clone, Debug)]
pub(super) struct History<S> {
    scenes: VecDeque<S>,
    length: usize,
}

impl<S: Clone> History<S> {
    /// For observations of `length` frames.
    pub fn new(length: usize) -> Self {
        History { scenes: VecDeque::with_capacity(length), length }
    }

    /// Frames in an observation.
    pub fn length(&self) -> usize {
        self.length
    }

    /// An episode starts: its first frame stands for those before it.
    pub fn restart(&mut self, scene: impl FnOnce() -> S) {
        self.scenes.clear();
        if self.length > 1 {
            self.scenes.resize(self.length, scene());
        }
    }

    /// The episode goes on.
    pub fn push(&mut self, scene: impl FnOnce() -> S) {
        if self.length > 1 {
            self.scenes.pop_front();
            self.scenes.push_back(scene());
        }
    }

    /// The scenes of the observation's frames, of which `last` is the last.
    pub fn scenes(&self, last: impl FnOnce() -> S) -> impl Iterator<Item = S> {
        let last = (self.length == 1).then(last);
        self.scenes.iter().cloned().chain(last)
    }
}
