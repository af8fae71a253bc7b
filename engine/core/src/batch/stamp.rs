//! The generation stamp of a batch: which write of which pool drew its frames.

use bytemuck::{Pod, Zeroable};

use super::block::Block;
use super::layout::Layout;

/// Identifies the last write into a batch.
///
/// A pool that finds the stamp of its own last write into a buffer knows the scene that each frame shows, and repaints only the
/// differences. With any other stamp, such as that of a batch that was copied or overwritten, it draws every frame in full. An
/// all-zero stamp means no stamp.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Stamp {
    /// The pool's random identity.
    pub pool: u64,
    /// Index of the pool's record of the buffer.
    pub buffer: u64,
    /// Generation counter: number of the write among all writes of the pool, from 1.
    pub generation: u64,
}

impl Stamp {
    /// The stamp of a batch; zeros if the batch is too short to have one.
    pub fn read(layout: &Layout, batch: &[Block]) -> Stamp {
        batch.get(layout.section_blocks()).map_or_else(Stamp::default, |block| {
            *bytemuck::from_bytes(&bytemuck::bytes_of(block)[..size_of::<Stamp>()])
        })
    }

    /// Stamps a batch.
    pub fn write(self, layout: &Layout, batch: &mut [Block]) {
        if let Some(block) = batch.get_mut(layout.section_blocks()) {
            bytemuck::bytes_of_mut(block)[..size_of::<Stamp>()].copy_from_slice(bytemuck::bytes_of(&self));
        }
    }
}

impl Layout {
    /// Removes the stamp of `batch`, so that the next pool that writes into it draws every frame in full. Call it between a
    /// change to the frames and the pool's next write into the same memory.
    pub fn forget_frames(&self, batch: &mut [Block]) {
        Stamp::default().write(self, batch);
    }
}

#[cfg(test)]
mod tests {
    use super::super::block::zeroed;
    use super::super::layout::batch_layout;
    use super::super::sections::{BatchSection, Contents};
    use super::*;
    use crate::toy::toys;

    #[test]
    fn the_stamp_lies_behind_the_sections() {
        let contents = Contents { features: true, ..Contents::default() };
        let layout = batch_layout(toys().specs().next().unwrap(), 3, contents).unwrap();
        let mut batch = zeroed(layout.blocks());
        let stamp = Stamp { pool: 7, buffer: 1, generation: 2 };
        stamp.write(&layout, &mut batch);
        assert_eq!(Stamp::read(&layout, &batch), stamp);
        let last = layout.sections().last().unwrap();
        assert_eq!(last.name(), BatchSection::Info);
        assert!(layout.read::<f64>(&batch, last.name()).iter().all(|number| *number == 0.0));
        layout.forget_frames(&mut batch);
        assert_eq!(Stamp::read(&layout, &batch), Stamp::default());
        assert_eq!(Stamp::read(&layout, &batch[..layout.blocks() - 1]), Stamp::default());
    }
}
