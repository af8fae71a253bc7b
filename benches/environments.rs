//! Cost of a single environment, by id: a step without drawing, a reset, a full frame, and the features.

mod actions;

use std::sync::Arc;

use criterion::{BenchmarkGroup, Criterion, criterion_group, criterion_main, measurement::WallTime};
use endless_gym_core::envs::{EnvSpec, Environment, ResetParameters};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;
use endless_gym_memory_gym::mortar_mayhem::{self, MortarMayhem};
use endless_gym_memory_gym::mystery_path::{self, MysteryPath};
use endless_gym_memory_gym::searing_spotlights::{self, SearingSpotlights};
use endless_gym_memory_gym::{FRAME, SCREEN};
use serde_json::Map;

use actions::Actions;

fn measure<E: Environment>(group: &mut BenchmarkGroup<'_, WallTime>, spec: &EnvSpec, variant: E::Variant) {
    let parameters = ResetParameters::new(spec.id, spec.parameters, &Map::new()).unwrap();
    let assets = Arc::new(E::assets(variant, &parameters));
    let mut env = E::new(&assets);
    let mut random = Generator::from_seed(1);
    env.reset(&assets, &mut random);
    let mut actions = Actions::new(spec, 1);
    group.bench_function(format!("{}/step", spec.id), |bencher| {
        bencher.iter(|| {
            if env.step(actions.next(), &mut random).terminated {
                env.reset(&assets, &mut random);
            }
        });
    });
    group.bench_function(format!("{}/reset", spec.id), |bencher| bencher.iter(|| env.reset(&assets, &mut random)));
    let mut frame = vec![0; FRAME.bytes()];
    group.bench_function(format!("{}/draw", spec.id), |bencher| {
        bencher.iter(|| E::paint(env.shared(), &env.scene(), &mut Canvas::new(&mut frame, SCREEN, SCREEN)));
    });
    let mut features = vec![0.0; spec.features.len()];
    group.bench_function(format!("{}/features", spec.id), |bencher| bencher.iter(|| env.features(&mut features)));
}

fn environments(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("environment");
    mortar_mayhem::IDS.iter().for_each(|(spec, variant)| measure::<MortarMayhem>(&mut group, spec, *variant));
    mystery_path::IDS.iter().for_each(|(spec, variant)| measure::<MysteryPath>(&mut group, spec, *variant));
    searing_spotlights::IDS.iter().for_each(|(spec, variant)| measure::<SearingSpotlights>(&mut group, spec, *variant));
    group.finish();
}

criterion_group!(benches, environments);
criterion_main!(benches);
