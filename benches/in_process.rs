//! Cost of one environment's step, reset and draw in process, on one thread.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use endless_gym::batch::zeroed;
use endless_gym::envs;
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

const NUM_ENVS: usize = 1024;

fn step(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("step");
    group.throughput(Throughput::Elements(NUM_ENVS as u64));
    for spec in envs::specs() {
        let config = PoolConfig { seeding: Seeding::Continue { seed: Some(1) }, ..PoolConfig::new(spec.id, NUM_ENVS) };
        let mut pool = Pool::new(&config, &Threads::new(1).unwrap()).unwrap();
        let mut batch = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut batch).unwrap();
        let branches = spec.action_space.branches();
        let mut random = SmallRng::seed_from_u64(1);
        let mut actions = vec![0; NUM_ENVS * branches.len()];
        group.bench_function(spec.id, |bencher| {
            bencher.iter(|| {
                for action in actions.chunks_exact_mut(branches.len()) {
                    action.iter_mut().zip(branches).for_each(|(a, n)| *a = random.random_range(0..*n));
                }
                pool.step(&actions, &mut batch).unwrap();
            });
        });
    }
    group.finish();
}

criterion_group!(benches, step);
criterion_main!(benches);
