//! Recorded episodes of an environment's reference implementation: their format, their replay in this engine, and recordings of this
//! engine in that format.
//!
//! A trace file is gzipped JSON: one environment object of the reference, which plays several episodes in a row.
//!
//! ```text
//! {"env": id, "options": {reset parameter: value},
//!  "episodes": [{"seed": number or null, "reset_crc": n, "reset_info": {}, "reset_vector": [..],
//!                "steps": [[action, reward, done, crc, info], ..]}]}
//! ```
//!
//! `crc` is the CRC-32 of the observation's bytes; a `seed` of `null` continues the object's generator; `reset_vector` is the
//! vector observation, if there is one. A step may end with a sixth element, the CRC-32 of the ground-truth view.

mod format;
mod record;
mod replay;

pub use format::{Episode, Step, Trace, TraceError};
pub use record::Recorder;
pub use replay::{Difference, Replay, replay};
