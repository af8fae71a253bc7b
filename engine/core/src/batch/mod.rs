//! The layout of one batch in memory.
//!
//! A **batch** is what one step of a group of environments yields: one contiguous piece of memory, in this process or in
//! shared memory, with an array for each quantity (a *section*), each aligned to 64 bytes. [`Layout`] is the only description of
//! it; the pool writes through [`BatchMut`], readers read through [`Batch`].
//!
//! | section | type, row shape | what |
//! | --- | --- | --- |
//! | `observation` | uint8 (84, 84, 3) | the frame, indexed \[x\]\[y\]\[channel\] as the original returns it; or as [`Frames`] says; unless left out |
//! | `vector_observation` | float32 (180,) | the commands, one-hot; ids with `MortarMayhemB` only |
//! | `features` | float32 (k,) | what the frame shows, in numbers; only where asked for |
//! | `reward` | float64 () | reward of this step |
//! | `terminated`, `truncated` | uint8 () | 1 where this step ended the episode |
//! | `episode_return` | float64 () | sum of the running episode's rewards, this step included |
//! | `episode_length` | int32 () | steps of the running episode, this step included |
//! | `ground_truth` | float64 (k,) | what the original's info calls `ground_truth`; ids that have it only |
//! | `info` | float64 (k,) | the original's further final infos, in the order of the environment's specification; zero in steps that do not end an episode |
//! | `final_*` | as the section it is named after | same-step auto-reset, where asked for: the last values of an episode that ended in this step; other rows keep whatever was there |
//!
//! Behind the sections lies a block that belongs to the pool: it tells which of its writes the frames are from, so that the next
//! one changes only what differs. Frames in a batch that a pool is to write into again are not to be changed by anybody else;
//! whoever does calls [`Layout::forget_frames`] after it.
//!
//! In same-step auto-reset, `observation`, `vector_observation`, `features` and `ground_truth` already belong to the next
//! episode in a step that ends one, while reward, flags, `episode_*` and `info` belong to the episode that ended.

mod block;
mod frames;
mod layout;
mod stamp;
mod view;

pub use block::{BLOCK_BYTES, Block, blocks_for, zeroed};
pub use frames::{Frames, MAX_STACK};
pub use layout::{Dtype, Element, Layout, Section};
pub(crate) use stamp::Stamp;
pub use view::{Batch, BatchMut, Contents, OPTIONS_BYTES, RowsMut, SNAPSHOT_BYTES, action_layout, batch_layout};

/// Version of the sections' meaning and of the messages that carry batches. A trainer refuses an engine of another version.
///
/// Version 4: the specification's key `epoch` became `incarnation`, the message headers have new type names, and a reset with a seed
/// counts the environments of all groups.
pub const LAYOUT_VERSION: u32 = 4;
