//! Fuzz targets for input from users and other processes, made from arbitrary bytes.
//!
//! In a target, the library either refuses the input with an error, or plays it for a bounded number of steps. A target
//! fails if it panics or takes longer than [`BUDGET`]. `tests/properties.rs` calls the targets with generated and
//! recorded inputs; the package in `cargo-fuzz` runs them with libFuzzer.

mod actions;
mod checkpoints;
mod layouts;
mod options;
mod playing;
pub mod snapshots;
mod traces;
mod watchdog;

use arbitrary::Unstructured;
pub use playing::registry;
pub use watchdog::BUDGET;

/// A function of arbitrary bytes. An error means that it ended early because the input was too short.
pub type Target = fn(&mut Unstructured<'_>) -> arbitrary::Result<()>;

/// The targets by name.
pub const TARGETS: [(&str, Target); 6] = [
    ("actions", actions::target),
    ("checkpoints", checkpoints::target),
    ("layouts", layouts::target),
    ("options", options::target),
    ("snapshots", snapshots::target),
    ("traces", traces::target),
];

/// Calls the target of that name. The process is aborted if it takes longer than [`BUDGET`].
///
/// # Panics
///
/// If there is no such target, or if the target finds a fault.
pub fn run(name: &str, data: &[u8]) {
    let (_, target) = TARGETS.into_iter().find(|(known, _)| *known == name).expect("the name of a target");
    let _ = watchdog::within_budget(data.to_vec(), || target(&mut Unstructured::new(data)));
}

/// Number of runs of a property: the environment variable `PROPTEST_CASES`, or else `cases`.
pub fn property_cases(cases: u32) -> u32 {
    std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(cases)
}
