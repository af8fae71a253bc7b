//! The element type of every batch in memory.

use bytemuck::{Pod, Zeroable};

/// Bytes in one [`Block`]: a cache line on the processors that we run on.
pub const BLOCK_BYTES: usize = 64;

/// 64 bytes, aligned to 64 bytes.
///
/// A batch is a slice of blocks. That aligns every section without padding each byte, which is what asking iceoryx2 for an
/// alignment of a `[u8]` payload would do.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
#[repr(align(64))]
pub struct Block([u8; BLOCK_BYTES]);

/// Blocks that hold at least `bytes` bytes.
pub const fn blocks_for(bytes: usize) -> usize {
    bytes.div_ceil(BLOCK_BYTES)
}

/// A zeroed buffer of `blocks` blocks, for batches that stay in this process.
pub fn zeroed(blocks: usize) -> Vec<Block> {
    vec![Block::zeroed(); blocks]
}
