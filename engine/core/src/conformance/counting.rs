//! Counts the allocations of each thread.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    static ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

/// The system's allocator, which counts the allocations of each thread. [`check`](super::check) also checks that steps do
/// not allocate in programs and tests that have it:
///
/// ```
/// #[global_allocator]
/// static ALLOCATOR: endless_gym_core::conformance::CountingAllocator = endless_gym_core::conformance::CountingAllocator;
/// # assert!(endless_gym_core::conformance::check(endless_gym_memory_gym::memory_gym(), "MysteryPath-v0")
/// #     .unwrap().iter().any(|outcome| outcome.rule == "a step does not allocate" && outcome.problem.is_none()));
/// ```
pub struct CountingAllocator;

// SAFETY: All calls are forwarded unchanged to the system's allocator. Counting does not allocate, since the thread-local
// number has a constant initial value and no destructor.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
        // SAFETY: our caller upholds the contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
        // SAFETY: our caller upholds the contract.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
        // SAFETY: our caller upholds the contract.
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: our caller upholds the contract.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// Allocations of this thread so far, in programs and tests that have the [`CountingAllocator`].
pub fn allocations() -> usize {
    ALLOCATIONS.get()
}

/// Whether allocations of this thread are counted.
pub(super) fn is_counting() -> bool {
    let before = allocations();
    drop(std::hint::black_box(Box::new(0_u8)));
    allocations() > before
}
