//! Which buffers the pool has written into, and when: so that it knows what is in them without looking at their addresses.
//!
//! A buffer is known by the stamp in it. Memory that was recycled, copied, mapped anew, or written to by another pool has another
//! stamp than the one that was noted for it, or none, and is drawn in full.

use std::sync::atomic::{Ordering, fence};

use crate::batch::{Block, Layout, Stamp};

/// Most buffers that are known at a time. A trainer and its observers hold fewer.
const MOST: usize = 32;

/// The buffers of a pool.
#[derive(Debug)]
pub(super) struct Buffers {
    /// Tells the pool's stamps from all others'.
    pool: u64,
    /// By slot, the number of the last write.
    writes: Vec<u64>,
    last_write: u64,
}

/// A buffer that is to be written into.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Buffer {
    /// Where is noted what its frames show.
    pub slot: usize,
    /// What is noted there is still so.
    pub known: bool,
}

impl Buffers {
    /// No buffer is known. `identity` tells this pool's stamps from all others'.
    pub fn new(identity: u64) -> Self {
        // All zeros are no stamp.
        Buffers { pool: identity | 1, writes: Vec::new(), last_write: 0 }
    }

    /// Takes the stamp off a buffer that is about to be written into: until [`finish`](Buffers::finish), nobody knows it.
    pub fn begin(&mut self, layout: &Layout, batch: &mut [Block]) -> Buffer {
        let stamp = Stamp::read(layout, batch);
        let noted = usize::try_from(stamp.slot).ok().filter(|_| stamp.pool == self.pool);
        let known = noted.filter(|slot| self.writes.get(*slot) == Some(&stamp.write));
        let buffer = known.map_or_else(|| self.take_slot(), |slot| Buffer { slot, known: true });
        layout.forget_frames(batch);
        // Whatever ends this process from here on, the stamp is off before the first pixel changes.
        fence(Ordering::SeqCst);
        buffer
    }

    /// Stamps a buffer that has been written.
    pub fn finish(&mut self, buffer: Buffer, layout: &Layout, batch: &mut [Block]) {
        fence(Ordering::SeqCst);
        self.last_write += 1;
        self.writes[buffer.slot] = self.last_write;
        Stamp { pool: self.pool, slot: buffer.slot as u64, write: self.last_write }.write(layout, batch);
    }

    /// A new slot, or the one that was used least recently.
    fn take_slot(&mut self) -> Buffer {
        let oldest = (0..self.writes.len()).min_by_key(|slot| self.writes[*slot]);
        let slot = oldest.filter(|_| self.writes.len() == MOST).unwrap_or_else(|| {
            self.writes.push(0);
            self.writes.len() - 1
        });
        Buffer { slot, known: false }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::batch::{Contents, Frames, batch_layout, zeroed};
    use crate::envs;

    fn write(buffers: &mut Buffers, layout: &Layout, batch: &mut [Block]) -> Buffer {
        let buffer = buffers.begin(layout, batch);
        buffers.finish(buffer, layout, batch);
        buffer
    }

    fn layout() -> Layout {
        let contents = Contents { frames: Some(Frames::default()), features: false, final_observation: false };
        batch_layout(envs::specs().next().unwrap(), 1, contents)
    }

    #[test]
    fn a_buffer_is_known_from_its_second_write_on() {
        let (mut buffers, layout) = (Buffers::new(1), layout());
        let mut batches = [zeroed(layout.blocks()), zeroed(layout.blocks())];
        for known in [false, true, true] {
            for (slot, batch) in batches.iter_mut().enumerate() {
                assert_eq!(write(&mut buffers, &layout, batch), Buffer { slot, known });
            }
        }
    }

    #[test]
    fn copies_and_other_pools_buffers_are_not_known() {
        let (mut buffers, mut others, layout) = (Buffers::new(1), Buffers::new(3), layout());
        let mut batch = zeroed(layout.blocks());
        write(&mut buffers, &layout, &mut batch);
        assert!(!write(&mut others, &layout, &mut batch).known);
        assert!(!write(&mut buffers, &layout, &mut batch).known);
        let mut copy = batch.clone();
        assert!(write(&mut buffers, &layout, &mut batch).known);
        assert!(!write(&mut buffers, &layout, &mut copy).known, "the note is of the original's second write");
        let mut later = batch.clone();
        assert!(write(&mut buffers, &layout, &mut later).known, "a copy of the last write is as good");
        assert!(!write(&mut buffers, &layout, &mut batch).known, "but only one of the two");
    }

    #[test]
    fn a_buffer_whose_write_was_not_finished_is_not_known() {
        let (mut buffers, layout) = (Buffers::new(1), layout());
        let mut batch = zeroed(layout.blocks());
        write(&mut buffers, &layout, &mut batch);
        assert!(buffers.begin(&layout, &mut batch).known);
        assert!(!write(&mut buffers, &layout, &mut batch).known);
    }

    #[test]
    fn the_least_recently_written_buffer_is_forgotten() {
        let (mut buffers, layout) = (Buffers::new(1), layout());
        let mut batches = vec![zeroed(layout.blocks()); MOST + 1];
        batches.iter_mut().for_each(|batch| assert!(!write(&mut buffers, &layout, batch).known));
        assert!(write(&mut buffers, &layout, &mut batches[1]).known);
        assert_eq!(write(&mut buffers, &layout, &mut batches[0]), Buffer { slot: 2, known: false });
        assert_eq!(buffers.writes.len(), MOST);
    }
}
