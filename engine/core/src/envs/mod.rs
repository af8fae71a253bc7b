//! The environments: the trait that every family implements, specifications, and reset parameters.

mod action_space;
mod character;
mod character_sprites;
mod controls;
mod environment;
mod expert;
pub mod mortar_mayhem;
pub mod mystery_path;
mod parameters;
mod progress;
mod screen;
pub mod searing_spotlights;
mod spec;
mod task;
mod vector;
pub mod view;

pub use action_space::{ActionError, ActionSpace, InvalidActionSpace};
pub use environment::{Environment, InvalidState, Transition};
pub use expert::Expert;
pub use parameters::{Parameter, ParameterError, ParameterKind, ResetParameters};
pub use progress::Progress;
pub use screen::{FRAME_BYTES, Frame, SCREEN};
pub use spec::{ActionBranch, Choice, Column, EnvSpec, InfoColumn, UnknownEnvironment};
pub use task::{Task, TaskEnv};
