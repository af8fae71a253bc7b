//! The Memory Gym environments, bit-exact and fast.
//!
//! The modules follow the data: [`random`] and [`raster`] serve [`envs`], the rules and pictures of the environments; [`batch`]
//! describes the memory layout of one step of many environments; [`pool`] steps them in lockstep; [`trace`] replays recorded
//! episodes of the original.

#![deny(unsafe_code)]

pub mod batch;
pub mod envs;
mod memory_gym;
pub mod pool;
pub mod random;
pub mod raster;
pub mod trace;

pub use memory_gym::{DEFAULT_ENV_ID, memory_gym};

#[cfg(test)]
mod property_cases;
