//! An engine that steps many environments in lockstep, and what environments are made of.
//!
//! The modules follow the data: environments, which implement a trait of [`envs`], draw random numbers with [`random`] and frames with
//! [`raster`]; [`batch`] describes the memory layout of one step of many environments; [`pool`] steps them; [`trace`] records and
//! replays episodes. The environments themselves are crates of their own, such as `endless-gym-memory-gym`.

#![deny(unsafe_code)]

pub mod batch;
pub mod conformance;
pub mod envs;
pub mod files;
pub mod pool;
pub mod random;
pub mod raster;
pub mod trace;

#[allow(unsafe_code)] // Threads write disjoint parts of a batch.
mod disjoint;
mod printable;

pub use printable::printable;

#[cfg(test)]
mod toy;
