//! Cost of numpy's generator: seeding it, and its draws.

use criterion::{Criterion, criterion_group, criterion_main};
use endless_gym_core::random::{Generator, SeedSequence};

fn random(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("random");
    let mut seed = 0;
    group.bench_function("from_seed", |bencher| {
        bencher.iter(|| {
            seed += 1;
            Generator::from_seed(seed)
        });
    });
    group.bench_function("seed_sequence", |bencher| bencher.iter(|| SeedSequence::new(7).generate_state_u64::<4>()));
    let mut generator = Generator::from_seed(1);
    group.bench_function("integers", |bencher| bencher.iter(|| generator.integers(0, 9)));
    group.bench_function("random", |bencher| bencher.iter(|| generator.random()));
    group.bench_function("uniform", |bencher| bencher.iter(|| generator.uniform(-1.0, 1.0)));
    let items = [1, 2, 3, 4, 5];
    group.bench_function("choice", |bencher| bencher.iter(|| *generator.choice(&items)));
    group.finish();
}

criterion_group!(benches, random);
criterion_main!(benches);
