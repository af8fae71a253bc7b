//! Making sure that there is as much shared memory as the batches need.
//!
//! A segment in `/dev/shm` may be larger than what is left there; the process then dies of SIGBUS on the first touch of a page
//! too many, often hours into a run. So memory is asked for before it is written to.

use std::mem::MaybeUninit;

use rustix::io::Errno;
use rustix::mm::Advice;

use super::error::ServiceError;
use super::message::PayloadBlock;
use endless_gym_core::batch::BLOCK_BYTES;

const PATH: &str = "/dev/shm";

/// Bytes to spare for the middleware's own segments and for headers.
const MARGIN: u64 = 1 << 20;

/// The chunks that are known to be in memory, by address.
#[derive(Debug, Default)]
pub(super) struct Resident(Vec<usize>);

impl Resident {
    /// Whether `/dev/shm` has room for `chunks` batches of `blocks` blocks.
    pub(super) fn check_available(blocks: usize, chunks: usize) -> Result<(), ServiceError> {
        match available() {
            Some(available) => check(needed(blocks, chunks), available),
            None => Ok(()),
        }
    }

    /// Brings a chunk into memory if it is not known to be there.
    pub(super) fn admit(&mut self, chunk: &mut [MaybeUninit<PayloadBlock>]) -> Result<(), ServiceError> {
        let address = chunk.as_ptr().addr();
        if self.0.contains(&address) {
            return Ok(());
        }
        match populate(chunk) {
            // A kernel before 5.14 knows no such advice; the check above has to do.
            Ok(()) | Err(Errno::INVAL) => {
                self.0.push(address);
                Ok(())
            }
            Err(_) => Err(ServiceError::SharedMemoryTooSmall {
                needed: needed(chunk.len(), 1),
                available: available().unwrap_or(0),
                path: PATH,
            }),
        }
    }
}

fn needed(blocks: usize, chunks: usize) -> u64 {
    (blocks as u64).saturating_mul(BLOCK_BYTES as u64).saturating_mul(chunks as u64).saturating_add(MARGIN)
}

fn check(needed: u64, available: u64) -> Result<(), ServiceError> {
    if needed <= available { Ok(()) } else { Err(ServiceError::SharedMemoryTooSmall { needed, available, path: PATH }) }
}

/// Bytes that are left; `None` where the file system does not say, or has no limit.
fn available() -> Option<u64> {
    let file_system = rustix::fs::statvfs(PATH).ok()?;
    (file_system.f_blocks > 0).then(|| file_system.f_bavail.saturating_mul(file_system.f_frsize))
}

/// Sizes that the pages of the operating system may have.
const PAGES: [usize; 3] = [4 << 10, 16 << 10, 64 << 10];

/// Allocates the pages under `chunk` without changing what is in them.
fn populate(chunk: &mut [MaybeUninit<PayloadBlock>]) -> rustix::io::Result<()> {
    let start = chunk.as_mut_ptr();
    let mut pages = PAGES.into_iter();
    let mut page = pages.next().unwrap_or(1);
    loop {
        let above = start.addr() % page;
        let (first, length) = (start.wrapping_byte_sub(above), above + size_of_val(chunk));
        // SAFETY: the range covers whole pages that hold a part of `chunk`, which is mapped for writing; if it is not one of
        // whole pages, the call does nothing. The advice allocates pages and changes neither their content nor the mapping.
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
    fn pages_that_cannot_be_had_are_an_error_and_not_a_signal() {
        // The second page of the mapping lies behind the end of the file: touching it raises SIGBUS, as a full /dev/shm does.
        let page = PAGES[2];
        let path = std::env::temp_dir().join(format!("endless-preflight-{}", std::process::id()));
        let file = File::options().read(true).write(true).create(true).truncate(true).open(&path).unwrap();
        std::fs::remove_file(&path).unwrap();
        file.set_len(page as u64).unwrap();
        // SAFETY: a new mapping at an address of the system's choice, which stays for as long as the process.
        let start = unsafe {
            mmap(std::ptr::null_mut(), 2 * page, ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED, &file, 0)
        };
        let start = start.unwrap().cast::<MaybeUninit<PayloadBlock>>();
        let blocks = page / BLOCK_BYTES;
        // SAFETY: both pages are mapped for writing, nothing else uses them, and nobody touches the second.
        let (there, missing) = unsafe { std::slice::from_raw_parts_mut(start, 2 * blocks) }.split_at_mut(blocks);
        let mut resident = Resident::default();
        resident.admit(&mut there[1..]).unwrap();
        assert!(matches!(resident.admit(missing), Err(ServiceError::SharedMemoryTooSmall { .. })));
    }
}
