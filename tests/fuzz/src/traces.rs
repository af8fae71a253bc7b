//! Traces: JSON text. A trace plays no more steps than it has bytes.

use endless_gym_core::trace::{Trace, replay};

pub(crate) fn target(data: &[u8]) {
    if let Ok(trace) = serde_json::from_slice::<Trace>(data) {
        // Any result but a panic.
        let _ = replay(&trace);
    }
}
