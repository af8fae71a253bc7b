//! Endless Gym: the Memory Gym environments, bit for bit, at memory speed, in shared memory, for any trainer on the host.
//!
//! The way of the data is the order of the modules: [`random`] and [`raster`] serve [`envs`], the rules and pictures of the
//! environments; [`batch`] says how a step of many environments lies in memory; [`pool`] steps them in lockstep; [`service`]
//! puts the batches into shared memory, where a trainer reads them.

pub use endless_gym_cli as cli;
pub use endless_gym_core::{batch, envs, pool, random, raster, trace};
pub use endless_gym_service as service;

/// The examples of the README, as tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
