//! Neither a step nor an ordinary reset takes memory from the allocator.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use endless_gym::batch::zeroed;
use endless_gym::envs;
use endless_gym::pool::{Autoreset, Pool, PoolConfig, ResetRequest, Seeding, Threads};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

/// The system's allocator, with a count of the allocations.
struct Counting;

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: All calls are forwarded unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: as our caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as our caller promises.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: as our caller promises.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// One test, since others at the same time would be counted too.
#[test]
fn steps_and_resets_allocate_nothing() {
    for spec in envs::specs() {
        // As few as one thread steps, and enough for two.
        for (autoreset, num_envs, threads) in [(Autoreset::NextStep, 64, 2), (Autoreset::SameStep, 16, 1)] {
            let config = PoolConfig {
                seeding: Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(1) },
                autoreset,
                final_observation: true,
                features: true,
                ..PoolConfig::new(spec.id, num_envs)
            };
            let mut pool = Pool::new(&config, &Threads::new(threads).unwrap()).unwrap();
            let mut buffers = [zeroed(pool.layout().blocks()), zeroed(pool.layout().blocks())];
            let mut random = SmallRng::seed_from_u64(1);
            let branches = spec.action_space.branches();
            let mut actions = vec![0; num_envs * branches.len()];
            let mut play = |steps: usize| {
                for step in 0..steps {
                    let buffer = &mut buffers[step % 2];
                    if step % 500 == 0 {
                        pool.reset(ResetRequest::All, buffer).unwrap();
                    }
                    for action in actions.chunks_exact_mut(branches.len()) {
                        action.iter_mut().zip(branches).for_each(|(action, n)| *action = random.random_range(0..*n));
                    }
                    pool.step(&actions, buffer).unwrap();
                }
            };
            // Long enough for every list to have been as long as it gets.
            play(1500);
            let mut allocations = || {
                let before = ALLOCATIONS.load(Ordering::Relaxed);
                play(500);
                ALLOCATIONS.load(Ordering::Relaxed) - before
            };
            // Twice, since the test harness allocates when it says, once, that a test takes long.
            assert!(allocations() == 0 || allocations() == 0, "{}, {autoreset:?}", spec.id);
        }
    }
}
