//! The last frames of an episode, for observations of several frames.

use std::collections::VecDeque;
use std::sync::Arc;

/// A frame of an observation.
#[derive(Clone, Debug)]
pub(super) enum StackedFrame<S> {
    /// What it shows.
    Scene(S),
    /// Its pixels in the pool's format, where the scene is not known: a checkpoint stores frames and no scenes.
    Pixels(Arc<[u8]>),
}

/// The last frames of an episode, oldest first. Nothing is kept for observations of one frame.
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

    /// Replaces the oldest frame by a new scene.
    pub fn push(&mut self, scene: impl FnOnce() -> S) {
        if self.length > 1 {
            self.frames.pop_front();
            self.frames.push_back(StackedFrame::Scene(scene()));
        }
    }

    /// Replaces all frames but the newest by frames of these pixels.
    pub fn set_earlier(&mut self, frames: impl Iterator<Item = Arc<[u8]>>) {
        for (to, pixels) in self.frames.iter_mut().take(self.length - 1).zip(frames) {
            *to = StackedFrame::Pixels(pixels);
        }
    }

    /// All frames but the newest.
    pub fn earlier(&self) -> impl Iterator<Item = &StackedFrame<S>> {
        self.frames.iter().take(self.length - 1)
    }

    /// The observation's frames, oldest first. `last` returns the newest scene, which an observation of one frame has.
    pub fn frames(&self, last: impl FnOnce() -> S) -> impl Iterator<Item = StackedFrame<S>> {
        let last = (self.length == 1).then(|| StackedFrame::Scene(last()));
        self.frames.iter().cloned().chain(last)
    }
}
