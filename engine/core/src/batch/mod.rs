//! The layout of a batch in memory.
//!
//! A **batch** is the result of one step of a group of environments: one contiguous block of memory, in this process or in
//! shared memory, with an array, a *section*, for each quantity. [`BatchSection`] lists the sections, [`Layout`] describes
//! where they are, and [`Batch`] reads them. The message with which a trainer steps or resets a group has a layout of the same
//! kind: [`ActionSection`], [`ActionLayout`].
//!
//! Every section starts at a multiple of 64 bytes and has `num_envs` rows in C order.
//!
//! The sections of a batch are followed by one [`Block`] for the pool's generation stamp. A pool that finds the stamp of its
//! own last write into that memory repaints only what has changed since; with any other stamp it draws every frame in full.
//! After changing the frames of a batch that a pool will write into again, call [`Layout::forget_frames`].

mod block;
mod buffer;
mod dtype;
#[cfg(test)]
#[allow(unsafe_code)] // Takes a part of a batch.
mod forged_tests;
mod frames;
mod layout;
pub(crate) mod limits;
mod sections;
mod stamp;
#[allow(unsafe_code)] // Threads write disjoint parts of a batch.
mod view;

pub use block::{BLOCK_BYTES, Block, blocks_for, zeroed};
pub use buffer::BatchBuffer;
pub use dtype::{Dtype, Element};
pub use frames::{Frames, MAX_STACK};
pub use layout::{ActionLayout, Layout, LayoutError, MAX_DIMENSIONS, Section, action_layout, batch_layout};
pub use sections::{ActionSection, BatchSection, Contents, OPTIONS_BYTES, RowShape, SNAPSHOT_BYTES, SectionTable};
pub(crate) use stamp::Stamp;
pub use view::Batch;
pub(crate) use view::BatchMut;

/// Version of the sections' meaning and of the messages that carry batches. A trainer rejects an engine of another version.
pub const LAYOUT_VERSION: u32 = 8;
