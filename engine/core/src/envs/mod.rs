//! The environments: the trait that each fills, the registry of ids, and their reset parameters.

mod action_space;
pub mod character;
pub mod mortar_mayhem;
pub mod mystery_path;
mod parameters;
pub mod searing_spotlights;
mod spec;
mod steering;
mod vector;
pub mod view;

use std::fmt::Debug;
use std::sync::Arc;

use serde::{Serialize, de::DeserializeOwned};
use thiserror::Error;

use crate::random::Generator;
use crate::raster::Canvas;
pub use action_space::{ActionError, ActionSpace, InvalidActionSpace};
pub use parameters::{Kind, Parameter, ParameterError, ResetParameters};
pub use spec::{Column, FRAME_BYTES, InfoColumn, SCREEN, Spec};

/// Rules and pictures of one family of environments.
///
/// [`step`](Environment::step) changes the state, [`scene`](Environment::scene) says what it looks like, and
/// [`paint`](Environment::paint) paints that: none does another's work. One object plays many episodes, and what an episode
/// leaves behind matters, as in the original.
pub trait Environment: Send + Sync {
    /// What tells the family's ids apart.
    type Variant: Copy + Send + Sync;

    /// What all environments with the same reset parameters share: the parameters and the pictures made from them.
    type Assets: Send + Sync;

    /// All that changes while an environment is played; what a snapshot keeps.
    type State: Serialize + DeserializeOwned;

    /// What a frame shows, as a small value: with the assets, it decides every pixel. Two of them tell what has changed.
    type Scene: Clone + PartialEq + Debug + Send + Sync;

    /// Makes the shared part for one set of reset parameters.
    fn assets(variant: Self::Variant, parameters: &ResetParameters) -> Self::Assets;

    /// An environment that has not played yet; [`reset`](Environment::reset) it before anything else.
    fn new(assets: &Arc<Self::Assets>) -> Self;

    /// Starts an episode.
    fn reset(&mut self, assets: &Arc<Self::Assets>, random: &mut Generator);

    /// Plays one step. `action` has one number for each branch of the action space, each within its range.
    fn step(&mut self, action: &[i32], random: &mut Generator) -> Transition;

    /// The shared part that the environment now has.
    fn shared(&self) -> &Arc<Self::Assets>;

    /// What the observation shows.
    fn scene(&self) -> Self::Scene;

    /// Paints the observation, whatever was there before: all that lies within the canvas' clip.
    fn paint(assets: &Self::Assets, scene: &Self::Scene, canvas: &mut Canvas<'_>);

    /// Changes an observation that shows `shown` into one that shows `scene`, by painting what may differ.
    fn repaint(assets: &Self::Assets, shown: &Self::Scene, scene: &Self::Scene, canvas: &mut Canvas<'_>);

    /// Draws the observation in full: `frame` holds [`FRAME_BYTES`] bytes, indexed \[x\]\[y\]\[channel\].
    fn draw(&self, frame: &mut [u8]) {
        Self::paint(self.shared(), &self.scene(), &mut Canvas::new(frame, SCREEN, SCREEN));
    }

    /// Draws the original's ground-truth view on a canvas of the observation's size, before the original scales it up. The
    /// state changes where an original counts its views.
    fn draw_ground_truth(&mut self, canvas: &mut Canvas<'_>);

    /// Writes the vector observation; empty where the environment has none.
    fn vector_observation(&self, _out: &mut [f32]) {}

    /// Writes what the current frame shows as numbers, as the specification's `features` list them.
    fn features(&self, out: &mut [f32]);

    /// Writes the ground truth; empty where the environment has none.
    fn ground_truth(&self, _out: &mut [f64]) {}

    /// The state, for a snapshot.
    fn state(&self) -> &Self::State;

    /// Goes on from a state that an environment with these assets was in. One that no such environment can be in is refused,
    /// and changes nothing.
    fn restore(&mut self, assets: &Arc<Self::Assets>, state: Self::State) -> Result<(), InvalidState>;

    /// Writes the final info, as the specification's `info` lists it. Called in the step that ends the episode.
    fn info(&self, out: &mut [f64]);
}

/// What one step yields beside the observation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    /// The original's Python float.
    pub reward: f64,
    /// Whether the episode ended. The original reports every end, also that by the step limit, as `terminated`.
    pub terminated: bool,
}

/// A state that no environment with these reset parameters can be in.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error("the state is none that the environment can be in")]
pub struct InvalidState;

/// Plays an environment from its feature and vector observations, and remembers what an agent would have to.
pub trait Expert: Send {
    /// Forgets the last episode.
    fn reset(&mut self);

    /// Chooses an action. Call it once for each observation, the first of an episode included.
    fn act(&mut self, features: &[f32], vector_observation: &[f32], action: &mut [i32]);
}

/// The families of environments; each id belongs to one.
#[derive(Clone, Copy, Debug)]
pub enum Family {
    MortarMayhem(mortar_mayhem::Variant),
    MysteryPath(mystery_path::Variant),
    SearingSpotlights(searing_spotlights::Variant),
}

/// The environment id that commands and training programs use by default.
pub const DEFAULT_ENV_ID: &str = "Endless-MortarMayhem-v0";

/// Every environment id, in the order in which `endless list` shows them.
pub fn specs() -> impl Iterator<Item = &'static Spec> {
    mortar_mayhem::SPECS.iter().chain(mystery_path::SPECS).chain(searing_spotlights::SPECS)
}

/// The environment of that id.
pub fn spec(id: &str) -> Result<&'static Spec, UnknownEnvironment> {
    specs().find(|spec| spec.id == id).ok_or_else(|| UnknownEnvironment {
        id: id.to_owned(),
        known: specs().map(|spec| spec.id).collect::<Vec<_>>().join(", "),
    })
}

/// A scripted expert for the environment.
pub fn expert(spec: &Spec) -> Box<dyn Expert> {
    match spec.family {
        Family::MortarMayhem(variant) => Box::new(mortar_mayhem::expert::MortarExpert::new(variant)),
        Family::MysteryPath(variant) => Box::new(mystery_path::expert::PathExpert::new(variant)),
        Family::SearingSpotlights(variant) => Box::new(searing_spotlights::expert::SpotlightsExpert::new(variant)),
    }
}

/// An id that no environment has.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("no environment `{id}`; there are {known}")]
pub struct UnknownEnvironment {
    pub id: String,
    pub known: String,
}
