//! Panics of environments, as errors that name the environment.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};

use thiserror::Error;

/// An environment panicked: its code has a defect.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{id} panicked{}: {message}", place(*env, *seed))]
pub struct EnvPanic {
    /// The environment id.
    pub id: &'static str,
    /// Number of the environment in its pool; `None` while its reset parameters were applied.
    pub env: Option<usize>,
    /// Seed of its running episode; `None` if the episode continues the generator.
    pub seed: Option<u64>,
    /// The panic's message.
    pub message: String,
}

fn place(env: Option<usize>, seed: Option<u64>) -> String {
    let seed = seed.map_or("without a seed".to_owned(), |seed| format!("with seed {seed}"));
    env.map_or(" when its reset parameters were applied".to_owned(), |env| {
        format!(" in environment {env}, in an episode {seed}")
    })
}

/// Calls code of environments. The error is the message of a panic.
pub(super) fn catch<T>(call: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(call)).map_err(|panic| message(&*panic))
}

/// The message of a panic.
pub(crate) fn message(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str).or_else(|| panic.downcast_ref::<&str>().copied());
    text.unwrap_or("the panic's value is not text (`panic_any`)").to_owned()
}
