//! What an environment draws for its reset parameters is freed when it gets others.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use endless_gym::batch::{Block, zeroed};
use endless_gym::envs;
use endless_gym::pool::{NextOptions, Pool, PoolConfig, ResetRequest, Threads};

/// The system's allocator, with a count of the bytes in use.
struct Counting;

static BYTES: AtomicUsize = AtomicUsize::new(0);

// SAFETY: All calls are forwarded unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        BYTES.fetch_add(layout.size(), Ordering::Relaxed);
        // SAFETY: as our caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        BYTES.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: as our caller promises.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The options of environment `env` in round `round`: another set for each, with pictures of its own.
fn options(round: usize, env: usize) -> NextOptions {
    let scale = 0.2 + 0.001 * ((round * 4 + env) % 64) as f64;
    NextOptions { options: [("agent_scale".to_owned(), scale.into())].into_iter().collect(), envs: vec![env] }
}

/// Gives each environment options of its own and plays long enough to use what is made on first use, such as darker pictures.
fn play(pool: &mut Pool, round: usize, buffer: &mut [Block]) {
    let sets: Vec<_> = (0..4).map(|env| options(round, env)).collect();
    pool.set_options(&sets).unwrap();
    pool.reset(ResetRequest::All, buffer).unwrap();
    let actions = vec![0; 4 * pool.spec().action_space.branches().len()];
    for _ in 0..40 {
        pool.step(&actions, buffer).unwrap();
    }
}

/// One test, since others at the same time would be counted too.
#[test]
fn replaced_options_leave_no_memory_behind() {
    for spec in envs::specs() {
        let mut pool = Pool::new(&PoolConfig::new(spec.id, 4), &Threads::new(1).unwrap()).unwrap();
        let mut buffer = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::Seed(1), &mut buffer).unwrap();
        let mut used = |rounds: std::ops::Range<usize>| {
            rounds.clone().for_each(|round| play(&mut pool, round, &mut buffer));
            BYTES.load(Ordering::Relaxed)
        };
        let (first, last) = (used(0..16), used(16..128));
        // One picture more or less is in use at a time; the options of 112 rounds have thousands.
        assert!(last < first + (256 << 10), "{}: {first} bytes after 16 rounds, {last} bytes after 128", spec.id);
    }
}
