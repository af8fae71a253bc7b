//! Prefaulting: makes sure that shared memory is available before it is written to.
//!
//! A segment in `/dev/shm` may be larger than the free space there. SIGBUS then kills the process when it first writes
//! to a page that has no memory, possibly hours after its start. Each chunk is therefore prefaulted before its first
//! use, and missing memory is an error.

use std::mem::MaybeUninit;
use std::sync::{Mutex, PoisonError};

use rustix::io::Errno;
use rustix::mm::Advice;

use endless_gym_core::batch::BLOCK_BYTES;
use endless_gym_core::pool::Threads;

use crate::error::ServiceError;
use crate::namespace::segments::DIRECTORY;
use crate::os::resource_limits;

/// Bytes reserved for iceoryx2's own segments and for headers.
pub(crate) const MARGIN: u64 = 1 << 20;

/// Bytes that must be free for a process to join a namespace.
pub(crate) const NODE_BYTES: u64 = 64 << 10;

/// Fails if `/dev/shm` has fewer than `needed` bytes free. iceoryx2 writes to a new segment without allocating it first, which
/// raises SIGBUS if there is no memory, and SIGKILL if the control group may not have as much.
pub(crate) fn check_free(needed: u64) -> Result<(), ServiceError> {
    available().map_or(Ok(()), |available| check(needed, available))?;
    match resource_limits::control_group() {
        Some(limit) if limit < needed => Err(ServiceError::MemoryLimit { needed, limit }),
        _ => Ok(()),
    }
}

/// Prefaults chunks, each in parts by the threads that will write them, so that a part lies in the memory near its thread's core.
#[derive(Debug)]
pub(crate) struct PrefaultedChunks {
    /// Addresses of the chunks that have been prefaulted.
    addresses: Vec<usize>,
    threads: Threads,
}

impl PrefaultedChunks {
    /// Fails if `/dev/shm` has no room for `chunks` chunks of `blocks` blocks.
    pub(crate) fn check_available(blocks: usize, chunks: usize) -> Result<(), ServiceError> {
        check_free(needed(blocks, chunks))
    }

    /// No chunk yet.
    pub(crate) fn new(threads: &Threads) -> Self {
        PrefaultedChunks { addresses: Vec::new(), threads: threads.clone() }
    }

    /// Prefaults a chunk unless it has been prefaulted before.
    pub(crate) fn prefault<T: Send>(&mut self, chunk: &mut [MaybeUninit<T>]) -> Result<(), ServiceError> {
        let (address, bytes) = (chunk.as_ptr().addr(), size_of_val(chunk));
        if self.addresses.contains(&address) {
            return Ok(());
        }
        let part = chunk.len().div_ceil(self.threads.count()).max(1);
        let parts: Vec<_> = chunk.chunks_mut(part).map(|part| Mutex::new((part, Ok(())))).collect();
        self.threads.on_each(parts.len(), &|thread| {
            let Some(part) = parts.get(thread) else { return };
            let (part, result) = &mut *part.lock().unwrap_or_else(PoisonError::into_inner);
            *result = populate(part);
        });
        for part in parts {
            match part.into_inner().unwrap_or_else(PoisonError::into_inner).1 {
                // Linux before 5.14 does not support the advice; `check_available` must suffice.
                Ok(()) | Err(Errno::INVAL) => {}
                Err(_) => return Err(too_small(bytes as u64 + MARGIN)),
            }
        }
        self.addresses.push(address);
        Ok(())
    }
}

/// The error if `needed` bytes are not available.
pub(crate) fn too_small(needed: u64) -> ServiceError {
    ServiceError::SharedMemoryTooSmall { needed, available: available().unwrap_or(0), path: DIRECTORY }
}

fn needed(blocks: usize, chunks: usize) -> u64 {
    (blocks as u64).saturating_mul(BLOCK_BYTES as u64).saturating_mul(chunks as u64).saturating_add(MARGIN)
}

fn check(needed: u64, available: u64) -> Result<(), ServiceError> {
    if needed <= available {
        Ok(())
    } else {
        Err(ServiceError::SharedMemoryTooSmall { needed, available, path: DIRECTORY })
    }
}

/// Free bytes; `None` if the file system does not report them or has no limit.
fn available() -> Option<u64> {
    let file_system = rustix::fs::statvfs(DIRECTORY).ok()?;
    (file_system.f_blocks > 0).then(|| file_system.f_bavail.saturating_mul(file_system.f_frsize))
}

/// Possible page sizes of the operating system.
const PAGE_SIZES: [usize; 3] = [4 << 10, 16 << 10, 64 << 10];

/// Allocates the pages of `chunk` without changing their content.
fn populate<T>(chunk: &mut [MaybeUninit<T>]) -> rustix::io::Result<()> {
    let start = chunk.as_mut_ptr();
    let mut pages = PAGE_SIZES.into_iter();
    let mut page = pages.next().unwrap_or(1);
    loop {
        let above = start.addr() % page;
        let (first, length) = (start.wrapping_byte_sub(above), above + size_of_val(chunk));
        // SAFETY: the range covers the pages of `chunk`, which is mapped for writing. If `page` is not the page size, the call
        // fails without an effect. The advice allocates pages and changes neither their content nor the mapping.
        match unsafe { rustix::mm::madvise(first.cast(), length, Advice::LinuxPopulateWrite) } {
            Err(Errno::INTR | Errno::AGAIN) => {}
            Err(Errno::INVAL) => match pages.next() {
                Some(next) => page = next,
                None => return Err(Errno::INVAL),
            },
            result => return result,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use endless_gym_core::batch::Block;
    use rustix::mm::{MapFlags, ProtFlags, mmap};

    use super::*;

    #[test]
    fn too_little_memory_is_refused_with_both_numbers() {
        check(needed(1000, 5), 10_000_000).unwrap();
        let text = check(needed(1_000_000, 5), 64_000_000).unwrap_err().to_string();
        assert!(text.contains("322 MB") && text.contains("64 MB") && text.contains("/dev/shm"), "{text}");
        check(needed(usize::MAX, usize::MAX), u64::MAX - 1).unwrap_err();
    }

    #[test]
    fn missing_pages_are_an_error_and_not_a_signal() {
        // The second page of the mapping is beyond the end of the file: writing to it raises SIGBUS, as in a full /dev/shm.
        let page = PAGE_SIZES[2];
        let path = std::env::temp_dir().join(format!("endless-prefault-{}", std::process::id()));
        let file = File::options().read(true).write(true).create(true).truncate(true).open(&path).unwrap();
        std::fs::remove_file(&path).unwrap();
        file.set_len(page as u64).unwrap();
        // SAFETY: a new mapping at an address that the system chooses, which lasts until the process ends.
        let start = unsafe {
            mmap(std::ptr::null_mut(), 2 * page, ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED, &file, 0)
        };
        let start = start.unwrap().cast::<MaybeUninit<Block>>();
        let blocks = page / BLOCK_BYTES;
        // SAFETY: both pages are mapped for writing and not used elsewhere; the second is never accessed.
        let (present, missing) = unsafe { std::slice::from_raw_parts_mut(start, 2 * blocks) }.split_at_mut(blocks);
        for threads in [1, 2] {
            let mut chunks = PrefaultedChunks::new(&Threads::new(threads).unwrap());
            chunks.prefault(&mut present[1..]).unwrap();
            assert!(matches!(chunks.prefault(missing), Err(ServiceError::SharedMemoryTooSmall { .. })));
        }
    }
}
