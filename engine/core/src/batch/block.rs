//! The unit of memory of a batch.

use bytemuck::{Pod, Zeroable};

/// Bytes in one [`Block`]: a cache line on x86-64 and most ARM processors.
pub const BLOCK_BYTES: usize = 64;

/// 64 bytes, aligned to 64 bytes.
///
/// A batch is a slice of blocks, so every section that starts at a block is aligned for any number type and for vector
/// instructions, both in process memory and as the payload of an iceoryx2 sample.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
#[repr(align(64))]
pub struct Block([u8; BLOCK_BYTES]);

/// Number of blocks that hold at least `bytes` bytes.
pub const fn blocks_for(bytes: usize) -> usize {
    bytes.div_ceil(BLOCK_BYTES)
}

/// A zeroed buffer of `blocks` blocks in process memory.
pub fn zeroed(blocks: usize) -> Vec<Block> {
    vec![Block::zeroed(); blocks]
}
