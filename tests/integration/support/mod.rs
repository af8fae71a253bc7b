//! Helpers for the tests.

pub mod chromium;
pub mod foreign;
pub mod meeting;
pub mod page;
pub mod place;
pub mod player;
pub mod process;
pub mod recorded;
pub mod service;
