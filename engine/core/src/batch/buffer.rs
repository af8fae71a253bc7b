//! Process memory for a batch, on huge pages if the system has them.

use std::ops::{Deref, DerefMut};

use super::block::{Block, zeroed};

/// The memory of one batch in this process, zeroed. It dereferences to `[Block]`.
///
/// With the feature `huge-pages`, on Linux, a buffer of at least 4 MiB is a separate mapping that requests transparent huge
/// pages. A step writes a few cache lines of each environment's frame, so with pages of 4 KiB nearly every environment costs
/// TLB misses. A smaller buffer, or one that the kernel refuses, is a `Vec<Block>` as from [`zeroed`].
///
/// ```
/// use endless_gym_core::batch::BatchBuffer;
/// use endless_gym_memory_gym::memory_gym;
/// use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
///
/// let mut pool = Pool::new(memory_gym(), &PoolConfig::new("MysteryPath-Grid-v0", 256), &Threads::new(1)?)?;
/// let mut blocks = BatchBuffer::new(pool.layout().blocks());
/// pool.reset(ResetRequest::Seed(1), &mut blocks)?;
/// # Ok::<(), endless_gym_core::pool::PoolError>(())
/// ```
#[derive(Debug)]
pub struct BatchBuffer(Memory);

#[derive(Debug)]
enum Memory {
    Heap(Vec<Block>),
    #[cfg(all(feature = "huge-pages", target_os = "linux"))]
    Mapped(mapped::Mapped),
}

impl BatchBuffer {
    /// A zeroed buffer of `blocks` blocks. Its pages are allocated on their first write.
    pub fn new(blocks: usize) -> Self {
        #[cfg(all(feature = "huge-pages", target_os = "linux"))]
        if let Some(mapped) = mapped::Mapped::new(blocks) {
            return BatchBuffer(Memory::Mapped(mapped));
        }
        BatchBuffer(Memory::Heap(zeroed(blocks)))
    }
}

impl Deref for BatchBuffer {
    type Target = [Block];

    fn deref(&self) -> &[Block] {
        match &self.0 {
            Memory::Heap(blocks) => blocks,
            #[cfg(all(feature = "huge-pages", target_os = "linux"))]
            Memory::Mapped(mapped) => mapped.blocks(),
        }
    }
}

impl DerefMut for BatchBuffer {
    fn deref_mut(&mut self) -> &mut [Block] {
        match &mut self.0 {
            Memory::Heap(blocks) => blocks,
            #[cfg(all(feature = "huge-pages", target_os = "linux"))]
            Memory::Mapped(mapped) => mapped.blocks_mut(),
        }
    }
}

#[cfg(all(feature = "huge-pages", target_os = "linux"))]
#[allow(unsafe_code)] // Calls the kernel.
mod mapped {
    use std::ptr::{NonNull, null_mut};

    use rustix::mm::{Advice, MapFlags, ProtFlags, madvise, mmap_anonymous, munmap};

    use crate::batch::block::{BLOCK_BYTES, Block};

    /// Size of a huge page on x86-64, and on ARM with pages of 4 KiB.
    const HUGE_PAGE: usize = 2 << 20;

    /// Buffers below this size stay on the heap: they need few TLB entries.
    pub const LEAST_BYTES: usize = 4 << 20;

    /// An anonymous mapping that is advised to use huge pages.
    #[derive(Debug)]
    pub struct Mapped {
        start: NonNull<Block>,
        blocks: usize,
        /// Bytes of the mapping, which may be longer than the blocks.
        length: usize,
    }

    // SAFETY: it owns its memory, as a `Vec` does.
    unsafe impl Send for Mapped {}
    // SAFETY: as above.
    unsafe impl Sync for Mapped {}

    impl Mapped {
        /// `None` below [`LEAST_BYTES`], or if the kernel has no huge pages or refuses the mapping.
        pub fn new(blocks: usize) -> Option<Self> {
            let bytes = blocks.checked_mul(BLOCK_BYTES)?;
            if bytes < LEAST_BYTES {
                return None;
            }
            // Linux (6.7 and later) aligns a mapping to huge pages if its length is a multiple of them.
            let length = bytes.checked_next_multiple_of(HUGE_PAGE)?;
            let protection = ProtFlags::READ | ProtFlags::WRITE;
            // SAFETY: a new mapping at an address of the kernel's choice.
            let start = unsafe { mmap_anonymous(null_mut(), length, protection, MapFlags::PRIVATE) }.ok()?;
            let mapped = Mapped { start: NonNull::new(start.cast())?, blocks, length };
            // Only whole huge pages, so that the rest of the last one takes no memory.
            // SAFETY: the range is in the mapping, whose content the advice does not change.
            unsafe { madvise(start, bytes - bytes % HUGE_PAGE, Advice::LinuxHugepage) }.ok()?;
            Some(mapped)
        }

        pub fn blocks(&self) -> &[Block] {
            // SAFETY: the mapping has that many blocks, at first of zeros, and lives as long as `self`.
            unsafe { std::slice::from_raw_parts(self.start.as_ptr(), self.blocks) }
        }

        pub fn blocks_mut(&mut self) -> &mut [Block] {
            // SAFETY: as in `blocks`; `self` is borrowed exclusively.
            unsafe { std::slice::from_raw_parts_mut(self.start.as_ptr(), self.blocks) }
        }
    }

    impl Drop for Mapped {
        fn drop(&mut self) {
            // SAFETY: the whole mapping, which nothing borrows any more.
            let _ = unsafe { munmap(self.start.as_ptr().cast(), self.length) };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::block::{BLOCK_BYTES, blocks_for};
    use super::*;

    /// Sizes around 4 MiB and around a multiple of a huge page.
    const SIZES: [usize; 8] = [0, 64, 4096, (4 << 20) - 64, 4 << 20, (4 << 20) + 64, (6 << 20) - 64, 21_700_000];

    #[test]
    fn buffers_are_zeroed_and_aligned_and_have_the_requested_length() {
        for bytes in SIZES {
            let blocks = blocks_for(bytes);
            let mut buffer = BatchBuffer::new(blocks);
            assert_eq!(buffer.len(), blocks);
            assert_eq!(buffer.as_ptr().addr() % BLOCK_BYTES, 0);
            assert!(bytemuck::cast_slice::<_, u8>(&buffer).iter().all(|byte| *byte == 0), "{bytes} bytes");
            let address = buffer.as_mut_ptr();
            bytemuck::cast_slice_mut::<_, u8>(&mut buffer).fill(7);
            let moved = buffer;
            assert_eq!(moved.as_ptr(), address.cast_const());
            assert!(bytemuck::cast_slice::<_, u8>(&moved).iter().all(|byte| *byte == 7), "{bytes} bytes");
        }
    }

    #[test]
    #[cfg(all(feature = "huge-pages", target_os = "linux"))]
    fn only_large_buffers_are_mapped() {
        // A kernel without huge pages refuses the advice.
        let has_huge_pages = std::path::Path::new("/sys/kernel/mm/transparent_hugepage").exists();
        for bytes in SIZES {
            let large = bytes >= mapped::LEAST_BYTES;
            let buffer = BatchBuffer::new(blocks_for(bytes));
            assert_eq!(matches!(buffer.0, Memory::Mapped(_)), large && has_huge_pages, "{bytes} bytes");
        }
    }
}
