//! Fuzz targets for input from users and other processes, made from arbitrary bytes.
//!
//! In a target, the library either refuses the input with an error, or plays it for a bounded number of steps. A target
//! fails if it panics or takes longer than [`BUDGET`]. `tests/properties.rs` calls the targets with generated and
//! recorded inputs; the package in `cargo-fuzz` runs them with libFuzzer.

#![allow(clippy::missing_errors_doc, clippy::missing_panics_doc)] // `Target` and `run` say when.

pub mod actions;
pub mod checkpoints;
pub mod options;
mod playing;
pub mod snapshots;
pub mod traces;
mod watchdog;

use arbitrary::Unstructured;
pub use endless_gym::environments as registry;
pub use watchdog::BUDGET;

/// A function of arbitrary bytes. An error means that it ended early because the input was too short.
pub type Target = fn(&mut Unstructured<'_>) -> arbitrary::Result<()>;

/// Calls a target. The process is aborted if it takes longer than [`BUDGET`].
///
/// # Panics
///
/// If the target finds a fault.
pub fn run(target: Target, data: &[u8]) {
    let _ = watchdog::within_budget(data.to_vec(), || target(&mut Unstructured::new(data)));
}
