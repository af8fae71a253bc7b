//! Cost of painting in a step, and of what is made once for each set of reset parameters.

use criterion::{Criterion, criterion_group, criterion_main};
use endless_gym_core::raster::{Canvas, DirtySurface, Disc, PixelFormat, Rect, Sprite, Surface};
use endless_gym_memory_gym::{FRAME, SCREEN};

fn round_surface(side: usize) -> Surface {
    let mut surface = Surface::new(side, side);
    surface.set_color_key(Some([0; 3]));
    let half = side as i32 / 2;
    surface.draw_circle([200, 100, 50], (half, half), half, 0);
    surface
}

fn paint(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("raster/paint");
    let mut frame = vec![0; FRAME.bytes()];
    let mut canvas = Canvas::new(&mut frame, SCREEN, SCREEN);
    let picture = vec![7; FRAME.bytes()];
    group.bench_function("fill", |bencher| bencher.iter(|| canvas.fill([0, 0, 255])));
    group.bench_function("paste", |bencher| bencher.iter(|| canvas.paste(&picture)));
    let tile = Rect::new(24, 36, 12, 12);
    group.bench_function("paste_tile", |bencher| bencher.iter(|| canvas.clipped(tile).paste(&picture)));
    group.bench_function("rect", |bencher| bencher.iter(|| canvas.draw_rect([9, 8, 7], tile, 0)));
    let surface = round_surface(16);
    group.bench_function("blit_surface", |bencher| bencher.iter(|| canvas.blit(&surface, 30, 31)));
    let (sprite, disc) = (Sprite::new(&surface), Disc::new(16));
    group.bench_function("blit", |bencher| bencher.iter(|| sprite.blit(&mut canvas, 30, 31)));
    group.bench_function("blit_clipped", |bencher| bencher.iter(|| sprite.blit(&mut canvas, -5, 31)));
    let center = (36, 40);
    group.bench_function("blit_within", |bencher| {
        bencher.iter(|| sprite.blit_within(&mut canvas, 30, 31, &disc, center));
    });
    group.bench_function("shaded", |bencher| bencher.iter(|| sprite.shaded(100)));
    group.bench_function("disc", |bencher| bencher.iter(|| canvas.fill_disc([1, 2, 3], center, &disc)));
    group.finish();
}

fn store(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("raster/store");
    let mut surface = DirtySurface::new(SCREEN, SCREEN);
    surface.canvas().fill([10, 20, 30]);
    let mut picture = vec![0; FRAME.bytes()];
    let plain = PixelFormat::default();
    for (name, format) in [
        ("grayscale", PixelFormat { grayscale: true, ..plain }),
        ("channels_first", PixelFormat { channels_first: true, ..plain }),
        ("row_major", PixelFormat { row_major: true, ..plain }),
    ] {
        group.bench_function(name, |bencher| bencher.iter(|| format.store(&surface, &mut picture)));
    }
    group.finish();
}

fn make(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("raster/make");
    group.bench_function("circle", |bencher| bencher.iter(|| round_surface(64)));
    let surface = round_surface(64);
    group.bench_function("rotate", |bencher| bencher.iter(|| surface.rotate(45)));
    group.bench_function("sprite", |bencher| bencher.iter(|| Sprite::new(&surface)));
    group.finish();
}

criterion_group!(benches, paint, store, make);
criterion_main!(benches);
