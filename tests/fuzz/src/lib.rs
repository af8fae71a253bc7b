//! Fuzz targets: what a user or another process hands in, made from arbitrary bytes.
//!
//! A target refuses the input by an error of the library, or plays it for a bounded number of steps. It fails by a panic, or where
//! it takes longer than [`BUDGET`]. `tests/properties.rs` calls the targets with generated and recorded inputs; the package in
//! `cargo-fuzz` hands them to libFuzzer.

mod actions;
mod checkpoints;
mod layouts;
mod options;
mod playing;
pub mod snapshots;
mod traces;
mod watchdog;

use arbitrary::Unstructured;
pub use watchdog::BUDGET;

/// A function of arbitrary bytes. An error means that the input was too short, which ends it early.
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

/// Runs of a property: `cases`, or as many as the environment variable `PROPTEST_CASES` says.
pub fn property_cases(cases: u32) -> u32 {
    std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(cases)
}
