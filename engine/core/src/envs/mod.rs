//! What an environment is: the traits that it implements, its specification, and its reset parameters.

mod action_space;
mod environment;
mod expert;
mod parameters;
mod progress;
mod spec;
mod task;
pub mod view;

pub use action_space::{ActionError, ActionSpace, InvalidActionSpace, box_action, finite_bounds};
pub use environment::{Environment, InvalidState, Transition};
pub use expert::Expert;
pub use parameters::{Parameter, ParameterError, ParameterKind, ResetParameters};
pub use progress::Progress;
pub use spec::{
    ActionBranch, Choice, Column, EnvSpec, InfoColumn, Learnt, Metric, ObservationSpace, OriginalTypes, RewardType,
    StatePart, StateSpace, UnknownEnvironment,
};
pub use task::{Task, TaskEnv};
