//! Bytes and cache lines that a step paints, by id, since this traffic limits many environments:
//! `cargo bench --bench painted`.

mod actions;

use std::sync::Arc;

use endless_gym_core::envs::{EnvSpec, Environment, ResetParameters};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::DirtySurface;
use endless_gym_memory_gym::SCREEN;
use endless_gym_memory_gym::mortar_mayhem::{self, MortarMayhem};
use endless_gym_memory_gym::mystery_path::{self, MysteryPath};
use endless_gym_memory_gym::searing_spotlights::{self, SearingSpotlights};
use serde_json::Map;

use actions::Actions;

const STEPS: usize = 30_000;
const LINE: usize = 64;

fn measure<E: Environment>(spec: &EnvSpec, variant: E::Variant) {
    let parameters = ResetParameters::new(spec.id, spec.parameters, &Map::new()).unwrap();
    let assets = Arc::new(E::assets(variant, &parameters));
    let (mut env, mut random) = (E::new(&assets), Generator::from_seed(1));
    env.reset(&assets, &mut random);
    let (mut actions, mut surface, mut shown) = (Actions::new(spec, 1), DirtySurface::new(SCREEN, SCREEN), env.scene());
    let (mut bytes, mut lines, mut ended) = (0, 0, false);
    for _ in 0..STEPS {
        if ended {
            env.reset(&assets, &mut random);
            ended = false;
        } else {
            ended = env.step(actions.next(), &mut random).terminated;
        }
        let scene = env.scene();
        if shown != scene {
            E::repaint(&assets, &shown, &scene, &mut surface.canvas());
            surface.for_each_run(|x, rows, _| {
                let (start, end) = ((x * SCREEN + rows.start) * 3, (x * SCREEN + rows.end) * 3);
                bytes += end - start;
                lines += (end - 1) / LINE - start / LINE + 1;
            });
        }
        shown = scene;
    }
    let mean = |sum: usize| sum as f64 / STEPS as f64;
    println!("{:30} {:8.0} {:12.0} {:14}", spec.id, mean(bytes), mean(lines), size_of::<E::Scene>());
}

fn main() {
    println!("{:30} {:>8} {:>12} {:>14}", "a step of", "bytes", "cache lines", "bytes noted");
    mortar_mayhem::IDS.iter().for_each(|(spec, variant)| measure::<MortarMayhem>(spec, *variant));
    mystery_path::IDS.iter().for_each(|(spec, variant)| measure::<MysteryPath>(spec, *variant));
    searing_spotlights::IDS.iter().for_each(|(spec, variant)| measure::<SearingSpotlights>(spec, *variant));
}
