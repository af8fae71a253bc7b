//! Endless Gym: the Memory Gym environments, bit for bit, at memory speed, in shared memory, for any trainer on the host.
//!
//! The way of the data is the order of the modules: [`random`] and [`raster`] serve [`envs`], the rules and pictures of the
//! environments; [`batch`] says how a step of many environments lies in memory; [`pool`] steps them in lockstep; [`service`]
//! puts the batches into shared memory, where a trainer reads them.

pub mod batch;
pub mod cli;
pub mod envs;
pub mod pool;
pub mod random;
pub mod raster;
pub mod service;
pub mod trace;

/// The examples of the README, as tests.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;
