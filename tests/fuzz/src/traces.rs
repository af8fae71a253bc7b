//! Traces, as JSON text. A trace plays no more steps than it has bytes.

use arbitrary::{Result, Unstructured};
use endless_gym_core::trace::{Trace, replay};
use endless_gym_memory_gym::memory_gym;

/// The target.
pub fn target(input: &mut Unstructured<'_>) -> Result<()> {
    if let Ok(trace) = serde_json::from_slice::<Trace>(input.bytes(input.len())?) {
        // Any result is fine, except a panic.
        let _ = replay(memory_gym(), &trace);
    }
    Ok(())
}
