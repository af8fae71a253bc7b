//! The last frames of an episode, for stacked observations.

use std::collections::VecDeque;
use std::sync::Arc;

/// A frame of an observation.
#[derive(Clone, Debug)]
pub(super) enum StackedFrame<S> {
    /// A frame given by its scene.
    Scene(S),
    /// A frame given by its pixels in the pool's format: a checkpoint stores frames, not scenes.
    Pixels(Arc<[u8]>),
}

/// The last frames of an episode, oldest first. Empty for observations of one frame.
#[derive(Clone, Debug)]
pub(super) struct FrameStack<S> {
    frames: VecDeque<StackedFrame<S>>,
    length: usize,
}

impl<S: Clone> FrameStack<S> {
    /// A stack for observations of `length` frames.
    pub fn new(length: usize) -> Self {
        FrameStack { frames: VecDeque::with_capacity(length), length }
    }

    /// Frames in an observation.
    pub fn length(&self) -> usize {
        self.length
    }

    /// Fills the stack with the first scene of an episode.
    pub fn restart(&mut self, scene: impl FnOnce() -> S) {
        self.frames.clear();
        if self.length > 1 {
            self.frames.resize(self.length, StackedFrame::Scene(scene()));
        }
    }

    /// Replaces the oldest frame with a new scene.
    pub fn push(&mut self, scene: impl FnOnce() -> S) {
        if self.length > 1 {
            self.frames.pop_front();
            self.frames.push_back(StackedFrame::Scene(scene()));
        }
    }

    /// Replaces all frames except the newest with frames of these pixels.
    pub fn set_earlier(&mut self, frames: impl Iterator<Item = Arc<[u8]>>) {
        for (to, pixels) in self.frames.iter_mut().take(self.length - 1).zip(frames) {
            *to = StackedFrame::Pixels(pixels);
        }
    }

    /// All frames except the newest.
    pub fn earlier(&self) -> impl Iterator<Item = &StackedFrame<S>> {
        self.frames.iter().take(self.length - 1)
    }

    /// The observation's frames, oldest first. `last` returns the newest scene; it is called for observations of one frame
    /// only.
    pub fn frames(&self, last: impl FnOnce() -> S) -> impl Iterator<Item = StackedFrame<S>> {
        let last = (self.length == 1).then(|| StackedFrame::Scene(last()));
        self.frames.iter().cloned().chain(last)
    }
}
