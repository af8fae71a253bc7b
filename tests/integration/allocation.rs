//! The pool's use of the allocator. Each test runs in a separate process, so that it does not count the allocations of
//! other tests.

use std::alloc::{GlobalAlloc, Layout};
use std::sync::atomic::{AtomicUsize, Ordering};

use endless_gym::batch::zeroed;
use endless_gym::conformance::CountingAllocator;
use endless_gym::pool::{Autoreset, NextOptions, PoolConfig, ResetRequest, Seeding};
use endless_gym::{environments, memory_gym};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

use crate::support::player::Player;
use crate::support::process::alone;

/// Counts the allocations and the bytes in use of all threads.
struct Counting;

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);
static BYTES: AtomicUsize = AtomicUsize::new(0);

// SAFETY: All calls are forwarded unchanged to an allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        BYTES.fetch_add(layout.size(), Ordering::Relaxed);
        // SAFETY: our caller upholds the contract.
        unsafe { CountingAllocator.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        BYTES.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: our caller upholds the contract.
        unsafe { CountingAllocator.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
#[ignore = "slow"]
fn steps_and_resets_allocate_nothing() {
    if !alone("allocation::steps_and_resets_allocate_nothing") {
        return;
    }
    // Enough environments for two threads, few enough for one, and in one id enough for many.
    let sizes = [(Autoreset::NextStep, 64, 2), (Autoreset::SameStep, 16, 1), (Autoreset::NextStep, 320, 20)];
    for (number, spec) in environments().specs().enumerate() {
        for (autoreset, num_envs, threads) in sizes.into_iter().take(if number == 0 { 3 } else { 2 }) {
            let config = PoolConfig::new(spec.id, num_envs)
                .seeding(Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(1) })
                .autoreset(autoreset)
                .final_observation(true)
                .features(true);
            let mut player = Player::in_registry(environments(), &config, threads);
            let mut other = zeroed(player.blocks.len());
            let mut random = SmallRng::seed_from_u64(1);
            // In a Box, the bits of zeros.
            let branches = spec.action_space.branches();
            let mut actions = vec![0; num_envs * spec.action_space.width()];
            let mut play = |steps: usize| {
                for step in 0..steps {
                    std::mem::swap(&mut player.blocks, &mut other);
                    if step % 500 == 0 {
                        player.reset(ResetRequest::All);
                    }
                    for action in actions.chunks_exact_mut(spec.action_space.width()) {
                        action.iter_mut().zip(branches).for_each(|(action, n)| *action = random.random_range(0..*n));
                    }
                    player.step(&actions);
                }
            };
            // Long enough for every list to reach its maximum length.
            play(1500);
            let mut allocations = || {
                let before = ALLOCATIONS.load(Ordering::Relaxed);
                play(500);
                ALLOCATIONS.load(Ordering::Relaxed) - before
            };
            // Try twice, since the test harness allocates once when it reports that a test takes long.
            assert!(allocations() == 0 || allocations() == 0, "{}, {autoreset:?}", spec.id);
        }
    }
}

/// The options of environment `env` in round `round`: a different set for each, which needs different pictures.
fn options(round: usize, env: usize) -> NextOptions {
    let scale = 0.2 + 0.001 * ((round * 4 + env) % 64) as f64;
    NextOptions { options: [("agent_scale".to_owned(), scale.into())].into_iter().collect(), envs: vec![env] }
}

/// Gives each environment different options, and plays long enough to create everything that is made on first use, such
/// as darker pictures.
fn play(player: &mut Player, round: usize) {
    let sets: Vec<_> = (0..4).map(|env| options(round, env)).collect();
    player.pool.set_options(&sets).unwrap();
    player.reset(ResetRequest::All);
    (0..40).for_each(|_| player.step_all(0));
}

#[test]
fn replaced_options_leave_no_memory_behind() {
    if !alone("allocation::replaced_options_leave_no_memory_behind") {
        return;
    }
    for spec in memory_gym().specs() {
        let mut player = Player::new(&PoolConfig::new(spec.id, 4));
        player.reset(ResetRequest::Seed(1));
        let mut used = |rounds: std::ops::Range<usize>| {
            rounds.clone().for_each(|round| play(&mut player, round));
            BYTES.load(Ordering::Relaxed)
        };
        let (first, last) = (used(0..16), used(16..128));
        // The number of pictures in use varies by about one; the options of 112 rounds have thousands.
        assert!(last < first + (256 << 10), "{}: {first} bytes after 16 rounds, {last} bytes after 128", spec.id);
    }
}
