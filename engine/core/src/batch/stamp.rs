//! The pool's own note in a batch: which of its writes the frames are from.

use bytemuck::{Pod, Zeroable};

use super::block::Block;
use super::layout::Layout;

/// Says which pool wrote the frames of a batch, and in which of its writes.
///
/// A pool that finds its own last stamp in a batch knows what each frame shows, and changes only what differs. Any other stamp,
/// such as that of a batch which was copied or overwritten, makes it draw everything. All zeros are no stamp.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Stamp {
    /// A random number, one for each pool.
    pub pool: u64,
    /// Where the pool has noted what the frames show.
    pub slot: u64,
    /// Number of the write, counted from 1.
    pub write: u64,
}

impl Stamp {
    /// The stamp of a batch; none where there is no room for one.
    pub fn read(layout: &Layout, batch: &[Block]) -> Stamp {
        let block = layout.stamp_block().and_then(|at| batch.get(at));
        block.map_or_else(Stamp::default, |block| {
            *bytemuck::from_bytes(&bytemuck::bytes_of(block)[..size_of::<Stamp>()])
        })
    }

    /// Stamps a batch.
    pub fn write(self, layout: &Layout, batch: &mut [Block]) {
        if let Some(block) = layout.stamp_block().and_then(|at| batch.get_mut(at)) {
            bytemuck::bytes_of_mut(block)[..size_of::<Stamp>()].copy_from_slice(bytemuck::bytes_of(&self));
        }
    }
}
