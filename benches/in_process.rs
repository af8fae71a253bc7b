//! Cost of one environment's step, reset and draw in process, on one thread.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use endless_gym::batch::zeroed;
use endless_gym::envs;
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

/// Environments in a pool.
const SIZES: [usize; 2] = [64, 1024];

/// Steps after which the same actions are played again, in other states.
const ROUNDS: usize = 251;

fn step(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("step");
    for (spec, num_envs) in envs::specs().flat_map(|spec| SIZES.map(|num_envs| (spec, num_envs))) {
        group.throughput(Throughput::Elements(num_envs as u64));
        let config = PoolConfig { seeding: Seeding::Continue { seed: Some(1) }, ..PoolConfig::new(spec.id, num_envs) };
        let mut pool = Pool::new(&config, &Threads::new(1).unwrap()).unwrap();
        let mut batch = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut batch).unwrap();
        let branches = spec.action_space.branches();
        let mut random = SmallRng::seed_from_u64(1);
        // Drawn beforehand, since drawing them takes as long as many a step.
        let mut actions = vec![vec![0; num_envs * branches.len()]; ROUNDS];
        for action in actions.iter_mut().flat_map(|actions| actions.chunks_exact_mut(branches.len())) {
            action.iter_mut().zip(branches).for_each(|(a, n)| *a = random.random_range(0..*n));
        }
        let mut round = 0;
        group.bench_function(format!("{}/{num_envs}", spec.id), |bencher| {
            bencher.iter(|| {
                pool.step(&actions[round % ROUNDS], &mut batch).unwrap();
                round += 1;
            });
        });
    }
    group.finish();
}

criterion_group!(benches, step);
criterion_main!(benches);
