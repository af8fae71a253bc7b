//! Progress of an episode, for a human viewer.

use serde::Serialize;

/// One number that changes during an episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Progress {
    /// Name of what is counted, in the plural.
    pub name: &'static str,
    /// The current number.
    pub value: f64,
    /// The total, if there is one.
    pub of: Option<f64>,
}

impl Progress {
    /// A count without a total.
    pub fn count(name: &'static str, value: impl Into<f64>) -> Self {
        Progress { name, value: value.into(), of: None }
    }

    /// A part of a whole.
    pub fn share(name: &'static str, value: impl Into<f64>, of: impl Into<f64>) -> Self {
        Progress { name, value: value.into(), of: Some(of.into()) }
    }
}
