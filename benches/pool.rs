//! Cost of a pool's step: with one and several threads, and with other observation formats.

mod actions;

use criterion::{BenchmarkGroup, Criterion, Throughput, criterion_group, criterion_main, measurement::WallTime};
use endless_gym::batch::PixelFormat;
use endless_gym::batch::{Frames, zeroed};
use endless_gym::envs::EnvSpec;
use endless_gym::memory_gym;
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};

use actions::Actions;

fn measure(
    group: &mut BenchmarkGroup<'_, WallTime>,
    name: String,
    spec: &EnvSpec,
    config: &PoolConfig,
    threads: usize,
) {
    let mut pool = Pool::new(memory_gym(), config, &Threads::new(threads).unwrap()).unwrap();
    let mut batch = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::All, &mut batch).unwrap();
    let mut actions = Actions::new(spec, config.num_envs);
    group.throughput(Throughput::Elements(config.num_envs as u64));
    group.bench_function(name, |bencher| bencher.iter(|| pool.step(actions.next(), &mut batch).unwrap()));
}

fn config(spec: &EnvSpec, num_envs: usize) -> PoolConfig {
    PoolConfig::new(spec.id, num_envs).seeding(Seeding::Continue { seed: Some(1) })
}

/// Every id, with batches inside and beyond the CPU's caches.
fn step(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("pool/step");
    for (spec, num_envs) in memory_gym().specs().flat_map(|spec| [64, 1024, 16384].map(|num_envs| (spec, num_envs))) {
        measure(&mut group, format!("{}/{num_envs}", spec.id), spec, &config(spec, num_envs), 1);
    }
}

/// More threads for the same work.
fn threads(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("pool/threads");
    let cores = Threads::new(0).unwrap().count();
    let mut counts = vec![1, 2, 4, 8, 16, cores];
    counts.retain(|count| *count <= cores);
    counts.sort_unstable();
    counts.dedup();
    for id in ["Endless-MortarMayhem-v0", "SearingSpotlights-v0"] {
        let spec = memory_gym().spec(id).unwrap();
        for threads in &counts {
            measure(&mut group, format!("{id}/{threads}"), spec, &config(spec, 4096), *threads);
        }
    }
}

/// Cost of other formats compared with the original's.
fn formats(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("pool/formats");
    let spec = memory_gym().spec("Endless-MysteryPath-v0").unwrap();
    let plain = PixelFormat::default();
    for (name, format, stack) in [
        ("standard", plain, 1),
        ("grayscale", PixelFormat { grayscale: true, ..plain }, 1),
        ("channels_first", PixelFormat { channels_first: true, ..plain }, 1),
        ("row_major", PixelFormat { row_major: true, ..plain }, 1),
        ("grayscale_stack_4", PixelFormat { grayscale: true, ..plain }, 4),
        ("grayscale_stack_16", PixelFormat { grayscale: true, ..plain }, 16),
    ] {
        let config = config(spec, 64).frames(Some(Frames { format, stack }));
        measure(&mut group, name.to_owned(), spec, &config, 1);
    }
}

/// How long a periodic checkpoint stalls an engine: copying the states of 1,024 environments.
fn save(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("pool/save");
    for spec in memory_gym().specs() {
        for stack in [1, 4] {
            let frames = Some(Frames { stack, ..Frames::default() });
            let config = config(spec, 1024).frames(frames);
            let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).unwrap();
            pool.reset(ResetRequest::All, &mut zeroed(pool.layout().blocks())).unwrap();
            let name = format!("{}/stack_{stack}", spec.id);
            group.bench_function(name, |bencher| bencher.iter(|| pool.save().unwrap()));
        }
    }
}

criterion_group!(benches, step, threads, formats, save);
criterion_main!(benches);
