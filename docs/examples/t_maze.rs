//! An environment of one's own in a program that does with it all that `endless` does, beside those of Memory Gym:
//!
//! ```console
//! cargo run --release --example t_maze list TMaze-v0
//! cargo run --release --example t_maze bench --env TMaze-v0
//! cargo run --release --example t_maze serve --env TMaze-v0 --num-envs 64 --features
//! ```
//!
//! `endless new` writes a crate with the same task.

#[path = "t_maze/task.rs"]
mod task;

use std::process::ExitCode;

use endless_gym::pool::RegistryError;

fn main() -> Result<ExitCode, RegistryError> {
    Ok(endless_gym::program(&endless_gym::memory_gym().clone().with::<task::TMaze>()?))
}
