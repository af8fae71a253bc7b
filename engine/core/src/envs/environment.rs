//! The trait that every family of environments implements.

use std::fmt::Debug;
use std::sync::Arc;

use serde::{Serialize, de::DeserializeOwned};
use thiserror::Error;

use super::expert::Expert;
use super::parameters::{ParameterError, ResetParameters};
use super::progress::Progress;
use super::spec::EnvSpec;
use crate::random::Generator;
use crate::raster::Canvas;

/// The rules and pictures of one family of environments.
///
/// [`step`](Environment::step) changes the state, [`scene`](Environment::scene) describes what the state looks like, and
/// [`paint`](Environment::paint) and [`repaint`](Environment::repaint) draw scenes. One object plays many episodes. As in the
/// original, some state carries over from one episode to the next.
pub trait Environment: Send + Sync {
    /// Distinguishes the ids of the family.
    type Variant: Copy + Send + Sync + 'static;

    /// Shared by all environments with the same reset parameters: the parameters, and the pictures made from them.
    type Assets: Send + Sync;

    /// Everything that changes during play, and that a snapshot stores.
    type State: Serialize + DeserializeOwned;

    /// What a frame shows, as a small value. A scene and its assets determine every pixel, so comparing two scenes finds what
    /// has changed.
    type Scene: Clone + PartialEq + Debug + Send + Sync;

    /// Creates the shared assets for one set of reset parameters.
    fn assets(variant: Self::Variant, parameters: &ResetParameters) -> Self::Assets;

    /// Creates an environment. The caller must [`reset`](Environment::reset) it before any other call.
    fn new(assets: &Arc<Self::Assets>) -> Self;

    /// Seeds the generators that the rules keep themselves, before the reset of an episode that has a seed.
    fn seed(&mut self, _seed: u64) {}

    /// Starts an episode with these assets, which may differ from the last episode's.
    fn reset(&mut self, assets: &Arc<Self::Assets>, random: &mut Generator);

    /// Plays one step. `action` has one number for each branch of the action space, each within its range.
    fn step(&mut self, action: &[i32], random: &mut Generator) -> Transition;

    /// The assets of the current episode.
    fn shared(&self) -> &Arc<Self::Assets>;

    /// The scene that the observation shows.
    fn scene(&self) -> Self::Scene;

    /// Paints every pixel of a scene within the canvas' clip, whatever the canvas showed before.
    fn paint(assets: &Self::Assets, scene: &Self::Scene, canvas: &mut Canvas<'_>);

    /// Changes a canvas that shows `shown` into one that shows `scene`, by painting only what may differ.
    fn repaint(assets: &Self::Assets, shown: &Self::Scene, scene: &Self::Scene, canvas: &mut Canvas<'_>);

    /// Writes the pixels of a scene, for frames of 1 or 4 channels, which a canvas does not have. The byte of channel `c` of the pixel
    /// `(x, y)` is `(x * height + y) * channels + c`. All bytes are 0 before.
    fn write_pixels(_assets: &Self::Assets, _scene: &Self::Scene, _pixels: &mut [u8]) {}

    /// Draws the ground-truth view, with what is hidden from the agent, at the size of a frame. Advances the animations that advance with
    /// every view, if there are any.
    fn draw_ground_truth(&mut self, canvas: &mut Canvas<'_>);

    /// Sets these animations as if the view had been drawn once after the reset and after each earlier step.
    fn align_ground_truth(&mut self) {}

    /// Writes the vector observation; an environment without one writes nothing.
    fn vector_observation(&self, _out: &mut [f32]) {}

    /// Writes the feature observation, which describes the current frame, in the order of
    /// [`EnvSpec::features`](super::EnvSpec::features).
    fn features(&self, out: &mut [f32]);

    /// Writes the ground truth; an environment without one writes nothing.
    fn ground_truth(&self, _out: &mut [f64]) {}

    /// Writes the Markov state; an environment that does not tell it writes nothing.
    fn markov_state(&self, _out: &mut [f32]) {}

    /// The state, for a snapshot.
    fn state(&self) -> &Self::State;

    /// Restores a state of an environment with these assets.
    ///
    /// # Errors
    ///
    /// [`InvalidState`] if a number in the state is out of range. The environment is then unchanged.
    fn restore(&mut self, assets: &Arc<Self::Assets>, state: Self::State) -> Result<(), InvalidState>;

    /// Progress of the episode, for a human viewer. Valid at any time.
    fn progress(&self) -> Vec<Progress>;

    /// Writes the final info in the order of [`EnvSpec::info`](super::EnvSpec::info). Valid after the step that ended the
    /// episode.
    fn info(&self, out: &mut [f64]);

    /// A scripted expert, if the family has one. `parameters` has the id's arguments.
    fn expert(_variant: Self::Variant, _parameters: &ResetParameters) -> Option<Box<dyn Expert>> {
        None
    }

    /// Completes the specification of an id with arguments, as [`Task::with_arguments`](super::Task::with_arguments).
    ///
    /// # Errors
    ///
    /// [`ParameterError`] if the arguments do not go together.
    fn with_arguments(spec: EnvSpec, _parameters: &ResetParameters) -> Result<EnvSpec, ParameterError> {
        Ok(spec)
    }
}

/// What one step returns in addition to the observation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Transition {
    /// The reward, with the precision of a Python float.
    pub reward: f64,
    /// Whether the task ended the episode.
    pub terminated: bool,
    /// Whether something outside the task ended the episode, such as a step limit.
    pub truncated: bool,
}

/// The state has a number that is out of range.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error("the state has a number that is out of its range")]
pub struct InvalidState;
