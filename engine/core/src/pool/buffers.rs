//! Tracks the buffers that a pool has written into, and which of them still hold its last write into them.
//!
//! A buffer is identified by the generation stamp in its memory, not by its address. If memory was recycled, copied, remapped
//! or written by another pool, its stamp is missing or differs from the pool's record, and it is drawn in full. As with buffer
//! age (`EGL_EXT_buffer_age`), a buffer that is several writes old is updated from its own last content.

use std::sync::atomic::{Ordering, fence};

use crate::batch::{Block, Layout, Stamp};

/// Maximum number of recorded buffers. A trainer and its observers hold fewer.
const MAX_BUFFERS: usize = 32;

/// The generation of a record during a write. No stamp has it, and such a record is the first to be replaced.
const UNFINISHED: u64 = 0;

/// The records of a pool's buffers.
#[derive(Debug)]
pub(super) struct Buffers {
    /// The pool's random identity, which is part of its stamps.
    pool: u64,
    /// For each buffer, the generation of the last write into it, or [`UNFINISHED`].
    writes: Vec<u64>,
    /// The generation counter.
    last_write: u64,
}

/// A buffer during a write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Buffer {
    /// Index of its record, and of its drawn scenes.
    pub index: usize,
    /// Whether its content is the pool's last write into that record.
    pub current: bool,
}

impl Buffers {
    /// No records. `identity` distinguishes this pool's stamps from those of other pools.
    pub fn new(identity: u64) -> Self {
        // An all-zero stamp means no stamp.
        Buffers { pool: identity | 1, writes: Vec::new(), last_write: UNFINISHED }
    }

    /// Returns the record of the buffer of the next write, a new one if it has none, and removes the buffer's stamp. The
    /// record's drawn scenes change during the write, so no buffer is current for it until [`finish`](Buffers::finish): neither
    /// this one, nor a copy of it, nor the buffer that the record belonged to before.
    pub fn begin(&mut self, layout: &Layout, batch: &mut [Block]) -> Buffer {
        let stamp = Stamp::read(layout, batch);
        let index = usize::try_from(stamp.buffer).ok().filter(|_| stamp.pool == self.pool);
        let current = index.filter(|index| self.writes.get(*index) == Some(&stamp.generation));
        let buffer = current.map_or_else(|| self.take_record(), |index| Buffer { index, current: true });
        self.writes[buffer.index] = UNFINISHED;
        layout.forget_frames(batch);
        // If this process dies during the write, the stamp must be gone before the first pixel changes.
        fence(Ordering::SeqCst);
        buffer
    }

    /// Stamps a buffer after a write.
    pub fn finish(&mut self, buffer: Buffer, layout: &Layout, batch: &mut [Block]) {
        fence(Ordering::SeqCst);
        self.last_write += 1;
        self.writes[buffer.index] = self.last_write;
        Stamp { pool: self.pool, buffer: buffer.index as u64, generation: self.last_write }.write(layout, batch);
    }

    /// A new record, or the least recently used one.
    fn take_record(&mut self) -> Buffer {
        let oldest = (0..self.writes.len()).min_by_key(|index| self.writes[*index]);
        let index = oldest.filter(|_| self.writes.len() == MAX_BUFFERS).unwrap_or_else(|| {
            self.writes.push(UNFINISHED);
            self.writes.len() - 1
        });
        Buffer { index, current: false }
    }
}

#[cfg(test)]
mod model_tests;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::batch::{Contents, Frames, batch_layout, zeroed};
    use crate::toy::toys;

    fn write(buffers: &mut Buffers, layout: &Layout, batch: &mut [Block]) -> Buffer {
        let buffer = buffers.begin(layout, batch);
        buffers.finish(buffer, layout, batch);
        buffer
    }

    fn layout() -> Layout {
        let contents = Contents { frames: Some(Frames::default()), ..Contents::default() };
        batch_layout(toys().specs().next().unwrap(), 1, contents).unwrap()
    }

    #[test]
    fn a_buffer_is_current_from_its_second_write_on() {
        let (mut buffers, layout) = (Buffers::new(1), layout());
        let mut batches = [zeroed(layout.blocks()), zeroed(layout.blocks())];
        for current in [false, true, true] {
            for (index, batch) in batches.iter_mut().enumerate() {
                assert_eq!(write(&mut buffers, &layout, batch), Buffer { index, current });
            }
        }
    }

    #[test]
    fn the_least_recently_written_record_is_replaced() {
        let (mut buffers, layout) = (Buffers::new(1), layout());
        let mut batches = vec![zeroed(layout.blocks()); MAX_BUFFERS + 1];
        batches.iter_mut().for_each(|batch| assert!(!write(&mut buffers, &layout, batch).current));
        assert!(write(&mut buffers, &layout, &mut batches[1]).current);
        assert_eq!(write(&mut buffers, &layout, &mut batches[0]), Buffer { index: 2, current: false });
        assert_eq!(buffers.writes.len(), MAX_BUFFERS);
    }
}
