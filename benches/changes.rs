//! What descriptions of an observation's painted pixels cost a reader that keeps a copy: bytes and cache lines to copy, by id; also
//! those of what a pool notes, and of the pixels that differ. Deterministic counts over whole episodes with random actions and
//! next-step autoreset. `cargo bench --bench changes`.

mod actions;

use std::sync::Arc;

use endless_gym_core::envs::mortar_mayhem::MortarMayhem;
use endless_gym_core::envs::mystery_path::MysteryPath;
use endless_gym_core::envs::searing_spotlights::SearingSpotlights;
use endless_gym_core::envs::{self, EnvSpec, Environment, FRAME_BYTES, Family, ResetParameters, SCREEN};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::{Canvas, DirtyBands, DirtySurface};
use serde_json::Map;

use actions::Actions;

const STEPS: usize = 30_000;
const LINE: usize = 64;
const ROW: usize = SCREEN * 3;

/// Rows of the observation, which are columns of the screen; a bit for each pixel.
type Mask = [u128; SCREEN];

/// A description of changes: its name, its size in bytes, and the pixels that it names for these changes.
type Description = (&'static str, usize, fn(&Mask) -> Mask);

const WHOLE_ROW: u128 = u128::MAX >> (128 - SCREEN);

/// The smallest run that includes all bits.
fn span(bits: u128) -> u128 {
    if bits == 0 { 0 } else { u128::MAX << bits.trailing_zeros() & u128::MAX >> bits.leading_zeros() }
}

fn union(rows: &[u128]) -> u128 {
    rows.iter().fold(0, |all, row| all | row)
}

/// Fills tiles of some rows and pixels.
fn tiles<const ROWS: usize, const PIXELS: usize>(mask: &Mask) -> Mask {
    let mut found = *mask;
    for band in found.chunks_mut(ROWS) {
        let bits = union(band);
        let tile = |first: usize| u128::MAX >> (128 - PIXELS) << first & WHOLE_ROW;
        let named = (0..SCREEN).step_by(PIXELS).map(tile).filter(|tile| bits & tile != 0);
        band.fill(named.fold(0, |all, tile| all | tile));
    }
    found
}

/// A bitmap of rows, and a span of pixels for each band of them.
fn spans<const ROWS: usize>(mask: &Mask) -> Mask {
    let mut found = *mask;
    for band in found.chunks_mut(ROWS) {
        let named = span(union(band));
        band.iter_mut().filter(|row| **row != 0).for_each(|row| *row = named);
    }
    found
}

const DESCRIPTIONS: [Description; 9] = [
    ("rows", 11, |mask| mask.map(|row| if row == 0 { 0 } else { WHOLE_ROW })),
    ("rows, one span", 13, spans::<SCREEN>),
    ("rows, spans of 8 rows", 33, spans::<8>),
    ("a span for each row", 168, spans::<1>),
    ("tiles of 4 x 21", 11, tiles::<4, 21>),
    ("tiles of 8 x 8", 16, tiles::<8, 8>),
    ("tiles of 4 x 8", 29, tiles::<4, 8>),
    ("tiles of 4 x 4", 56, tiles::<4, 4>),
    ("pixels", 882, |mask| *mask),
];

/// What a pool notes of a change from one scene to another.
fn noted<E: Environment>(assets: &E::Assets, shown: &E::Scene, scene: &E::Scene) -> Mask {
    let mut dirty = DirtyBands::new(false);
    E::repaint(assets, shown, scene, &mut Canvas::without_pixels(SCREEN, SCREEN, &mut dirty));
    let mut mask: Mask = [0; SCREEN];
    for (rows, [bits, first, end]) in mask.chunks_mut(DirtyBands::BAND).zip(dirty.bands()) {
        let span = (u128::MAX << first) & !u128::MAX.unbounded_shl(u32::from(*end));
        rows.iter_mut().enumerate().filter(|(row, _)| bits >> row & 1 != 0).for_each(|(_, row)| *row = span);
    }
    mask
}

/// The pixels in which two frames differ.
fn differing(one: &[u8], other: &[u8]) -> Mask {
    let mut mask: Mask = [0; SCREEN];
    let pixels = one.as_chunks::<3>().0.iter().zip(other.as_chunks::<3>().0).enumerate();
    pixels.filter(|(_, (one, other))| one != other).for_each(|(at, _)| mask[at / SCREEN] |= 1 << (at % SCREEN));
    mask
}

/// Bytes, runs and distinct cache lines of these pixels.
fn count(mask: &Mask) -> [usize; 3] {
    let (mut bytes, mut runs, mut lines, mut last_line) = (0, 0, 0, usize::MAX);
    for (row, bits) in mask.iter().enumerate() {
        let mut rest = *bits;
        while rest != 0 {
            let start = rest.trailing_zeros() as usize;
            let end = start + (rest >> start).trailing_ones() as usize;
            let (from, to) = (row * ROW + start * 3, row * ROW + end * 3);
            bytes += to - from;
            runs += 1;
            let (first, last) = (from / LINE, (to - 1) / LINE);
            lines += last - first + usize::from(first != last_line);
            last_line = last;
            rest &= u128::MAX << end;
        }
    }
    [bytes, runs, lines]
}

fn measure<E: Environment>(spec: &'static EnvSpec, variant: E::Variant) {
    let parameters = ResetParameters::new(spec.id, spec.parameters, &Map::new()).unwrap();
    let assets = Arc::new(E::assets(variant, &parameters));
    let (mut env, mut random) = (E::new(&assets), Generator::from_seed(1));
    env.reset(&assets, &mut random);
    let (mut actions, mut surface, mut shown) = (Actions::new(spec, 1), DirtySurface::new(SCREEN, SCREEN), env.scene());
    let mut frame = vec![0; FRAME_BYTES];
    E::paint(&assets, &shown, &mut Canvas::new(&mut frame, SCREEN, SCREEN));
    let (mut sums, mut steps, mut ended) = ([[0; 3]; DESCRIPTIONS.len() + 2], 0, false);
    while !ended || steps < STEPS {
        if ended {
            env.reset(&assets, &mut random);
            ended = false;
        } else {
            ended = env.step(actions.next(), &mut random).terminated;
        }
        steps += 1;
        let scene = env.scene();
        if shown == scene {
            continue;
        }
        E::repaint(&assets, &shown, &scene, &mut surface.canvas());
        let (mut painted, before): (Mask, _) = ([0; SCREEN], frame.clone());
        surface.for_each_run(|x, rows, _| painted[x] |= u128::MAX >> (128 - rows.len()) << rows.start);
        E::repaint(&assets, &shown, &scene, &mut Canvas::new(&mut frame, SCREEN, SCREEN));
        let (noted, differing) = (noted::<E>(&assets, &shown, &scene), differing(&before, &frame));
        let described = DESCRIPTIONS.iter().map(|(_, _, describe)| describe(&painted));
        for (named, sum) in described.chain([noted, differing]).zip(&mut sums) {
            assert!(named.iter().zip(&differing).all(|(named, differs)| differs & !named == 0), "a change is missed");
            sum.iter_mut().zip(count(&named)).for_each(|(sum, counted)| *sum += counted);
        }
        shown = scene;
    }
    println!("{}", spec.id);
    let names = DESCRIPTIONS.iter().map(|(name, size, _)| (*name, *size)).chain([("noted", 33), ("that differ", 882)]);
    for ((name, size), sum) in names.zip(sums) {
        let [bytes, runs, lines] = sum.map(|sum| sum as f64 / f64::from(steps as u32));
        println!("    {name:24} {size:6} {bytes:8.0} {runs:8.1} {lines:8.1}");
    }
}

fn main() {
    println!("    {:24} {:>6} {:>8} {:>8} {:>8}", "changes as", "size", "bytes", "runs", "lines");
    for spec in envs::specs() {
        match spec.family {
            Family::MortarMayhem(variant) => measure::<MortarMayhem>(spec, variant),
            Family::MysteryPath(variant) => measure::<MysteryPath>(spec, variant),
            Family::SearingSpotlights(variant) => measure::<SearingSpotlights>(spec, variant),
        }
    }
}
