//! Replays drawings recorded from pygame, and draws with arguments that pygame never sees.

use proptest::prelude::*;
use proptest::test_runner::contextualize_config;
use serde::Deserialize;

use super::{Canvas, CornerRadii, Disc, Rect, Rgb, Sprite, Surface, circle_outline};

/// What pygame painted, recorded by `tests/raster/record_raster.py`.
#[derive(Deserialize)]
struct Cases {
    scenes: Vec<Vec<Operation>>,
    alpha_sweeps: Vec<AlphaSweep>,
}

/// An operation on the surface whose number comes first; new surfaces get the next number. Colours are 0xRRGGBB.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Operation {
    /// A new surface's size.
    Surface(usize, usize),
    Fill(usize, u32),
    ColorKey(usize, Option<u32>),
    Alpha(usize, i32),
    Noise(usize, u32),
    Circle(usize, u32, i32, i32, i32, i32),
    Line(usize, u32, i32, i32, i32, i32, i32),
    Rect(usize, u32, i32, i32, i32, i32, i32),
    RoundedRect(usize, u32, i32, i32, i32, i32, i32, u32, u32, u32, u32),
    /// The source of the new surface, and the degrees.
    Rotate(usize, i32),
    /// The source of the new surface, and its size.
    Scale(usize, usize, usize),
    /// The target, the source and the position.
    Blit(usize, usize, i32, i32),
    /// The expected size and checksum.
    Check(usize, usize, usize, u32),
}

/// Checksums of blending every level (columns) over every level (rows), by alpha.
#[derive(Deserialize)]
struct AlphaSweep {
    mode: String,
    sums: Vec<(i32, u32)>,
}

fn cases() -> Cases {
    serde_json::from_str(include_str!("../../tests/raster/cases.json")).unwrap()
}

fn rgb(color: u32) -> Rgb {
    let [_, r, g, b] = color.to_be_bytes();
    [r, g, b]
}

/// Pseudorandom colours; about an eighth of the pixels are 0x010203.
fn noise(surface: &mut Surface, seed: u32) {
    for (index, pixel) in (0u32..).zip(surface.pixels_mut().as_chunks_mut().0) {
        let mut value = index.wrapping_mul(2_654_435_761) ^ seed.wrapping_mul(2_246_822_519);
        value ^= value >> 15;
        value = value.wrapping_mul(2_246_822_519);
        value ^= value >> 13;
        *pixel = if value >> 29 == 0 { [1, 2, 3] } else { rgb(value) };
    }
}

fn replay(scene: &[Operation], surfaces: &mut Vec<Surface>) -> Result<(), String> {
    for (index, operation) in scene.iter().enumerate() {
        match *operation {
            Operation::Surface(width, height) => surfaces.push(Surface::new(width, height)),
            Operation::Fill(id, color) => surfaces[id].fill(rgb(color)),
            Operation::ColorKey(id, key) => surfaces[id].set_color_key(key.map(rgb)),
            Operation::Alpha(id, alpha) => surfaces[id].set_alpha(alpha),
            Operation::Noise(id, seed) => noise(&mut surfaces[id], seed),
            Operation::Circle(id, color, x, y, radius, width) => {
                surfaces[id].draw_circle(rgb(color), (x, y), radius, width);
            }
            Operation::Line(id, color, x0, y0, x1, y1, width) => {
                surfaces[id].draw_line(rgb(color), (x0, y0), (x1, y1), width);
            }
            Operation::Rect(id, color, x, y, w, h, width) => {
                surfaces[id].draw_rect(rgb(color), Rect::new(x, y, w, h), width);
            }
            Operation::RoundedRect(id, color, x, y, w, h, width, top_left, top_right, bottom_left, bottom_right) => {
                let radii = CornerRadii { top_left, top_right, bottom_left, bottom_right };
                surfaces[id].draw_rounded_rect(rgb(color), Rect::new(x, y, w, h), width, radii);
            }
            Operation::Rotate(source, degrees) => surfaces.push(surfaces[source].rotate(degrees)),
            Operation::Scale(source, width, height) => {
                surfaces.push(surfaces[source].scale_nearest(width, height));
            }
            Operation::Blit(id, source, x, y) => {
                let source = surfaces[source].clone();
                let mut painted = surfaces[id].clone();
                surfaces[id].blit(&source, x, y);
                if source.alpha() == 255 {
                    Sprite::new(&source).blit(&mut painted.canvas(), x, y);
                    if painted != surfaces[id] {
                        return Err(format!("operation {index}: the sprite differs in {operation:?}"));
                    }
                }
            }
            Operation::Check(id, width, height, sum) => {
                let surface = &surfaces[id];
                let size = (surface.width(), surface.height());
                if (size, crc32fast::hash(surface.pixels())) != ((width, height), sum) {
                    let before = &scene[index.saturating_sub(1)];
                    return Err(format!("operation {index}, {size:?}: {operation:?} after {before:?}"));
                }
            }
        }
    }
    Ok(())
}

#[test]
fn scenes_equal_pygames() {
    let scenes = cases().scenes;
    let failures: Vec<String> = scenes
        .iter()
        .enumerate()
        .filter_map(|(number, scene)| Some(format!("scene {number}, {}", replay(scene, &mut Vec::new()).err()?)))
        .collect();
    assert!(failures.is_empty(), "{} of {}: {:#?}", failures.len(), scenes.len(), &failures[..failures.len().min(20)]);
}

#[test]
fn translucent_blits_equal_pygames() {
    let mut over = Surface::new(256, 256);
    let mut below = Surface::new(256, 256);
    for (index, pixel) in over.pixels_mut().as_chunks_mut().0.iter_mut().enumerate() {
        *pixel = [(index / 256) as u8; 3];
    }
    for (index, pixel) in below.pixels_mut().as_chunks_mut().0.iter_mut().enumerate() {
        *pixel = [index as u8; 3];
    }
    for AlphaSweep { mode, sums } in cases().alpha_sweeps {
        for (alpha, sum) in sums {
            let mut source = over.clone();
            source.set_color_key((mode != "plain").then_some([1, 2, 3]));
            source.set_alpha(alpha);
            if mode == "encoded" {
                source = source.rotate(0);
            }
            let mut target = below.clone();
            target.blit(&source, 0, 0);
            assert_eq!(crc32fast::hash(target.pixels()), sum, "{mode}, alpha {alpha}");
        }
    }
}

/// Ordinary, large and extreme numbers.
fn any_number() -> impl Strategy<Value = i32> {
    prop_oneof![-100..200i32, -100_000..100_000i32, any::<i32>(), Just(i32::MIN), Just(i32::MAX)]
}

fn any_position() -> impl Strategy<Value = (i32, i32)> {
    (any_number(), any_number())
}

/// A small picture with a colour key and holes.
fn any_picture() -> impl Strategy<Value = Surface> {
    (0..20usize, 0..20usize, any::<u32>()).prop_map(|(width, height, seed)| {
        let mut surface = Surface::new(width, height);
        noise(&mut surface, seed);
        surface.set_color_key(Some([1, 2, 3]));
        surface
    })
}

proptest! {
    #![proptest_config(contextualize_config(ProptestConfig::with_cases(400)))]

    #[test]
    fn shapes_of_any_numbers_are_drawn(
        size in (0..60usize, 0..60usize),
        a in any_position(),
        b in any_position(),
        width in any_number(),
        radii in any::<[u32; 4]>(),
    ) {
        let mut surface = Surface::new(size.0, size.1);
        let color = [1, 2, 3];
        surface.draw_line(color, a, b, width);
        surface.draw_circle(color, a, b.0, width);
        surface.draw_circle(color, a, b.0, 1);
        surface.draw_circle(color, a, b.0, 0);
        let rect = Rect::new(a.0, a.1, b.0, b.1);
        let [top_left, top_right, bottom_left, bottom_right] = radii;
        surface.draw_rect(color, rect, width);
        for radii in [
            CornerRadii { top_left, top_right, bottom_left, bottom_right },
            CornerRadii { top_left: top_left % 50, top_right: top_right % 50, ..CornerRadii::default() },
        ] {
            surface.draw_rounded_rect(color, rect, width, radii);
            surface.draw_rounded_rect(color, rect, 0, radii);
        }
    }

    #[test]
    fn pictures_are_turned_scaled_and_blitted_anywhere(
        picture in any_picture(),
        degrees in any_number(),
        size in (0..60usize, 0..60usize),
        at in any_position(),
        alpha in any_number(),
    ) {
        let mut target = Surface::new(size.0, size.1);
        let mut picture = picture.rotate(degrees).scale_nearest(size.1, size.0);
        target.blit(&picture, at.0, at.1);
        picture.set_alpha(alpha);
        target.blit(&picture, at.0, at.1);
    }

    #[test]
    fn a_sprite_paints_what_its_surface_paints(
        picture in any_picture(),
        near in (-25..60i32, -25..60i32),
        far in any_position(),
    ) {
        let sprite = Sprite::new(&picture);
        let bounds = sprite.bounds();
        for (x, y) in [near, far] {
            let mut blitted = Surface::new(40, 30);
            let mut painted = blitted.clone();
            blitted.blit(&picture, x, y);
            sprite.blit(&mut Canvas::new(painted.pixels_mut(), 40, 30), x, y);
            prop_assert_eq!(&blitted, &painted);
            // Nothing may change outside the bounds.
            let left = i64::from(x) + i64::from(bounds.x);
            let top = i64::from(y) + i64::from(bounds.y);
            for (index, pixel) in painted.pixels().as_chunks::<3>().0.iter().enumerate() {
                let (column, row) = ((index / 30) as i64 - left, (index % 30) as i64 - top);
                let is_within =
                    (0..i64::from(bounds.width)).contains(&column) && (0..i64::from(bounds.height)).contains(&row);
                prop_assert!(is_within || *pixel == [0; 3]);
            }
        }
    }
}

proptest! {
    #[test]
    fn a_sprite_within_a_disc_is_cut_to_it(
        picture in any_picture(),
        at in (-30..60i32, -30..60i32),
        radius in -2..40i32,
        center in (-30..60i32, -30..60i32),
    ) {
        let (sprite, disc) = (Sprite::new(&picture), Disc::new(radius));
        let mut whole = Surface::new(33, 27);
        sprite.blit(&mut whole.canvas(), at.0, at.1);
        let mut lit = Surface::new(33, 27);
        lit.canvas().fill_disc([255; 3], center, &disc);
        let mut found = Surface::new(33, 27);
        sprite.blit_within(&mut found.canvas(), at.0, at.1, &disc, center);
        for (x, y) in (0..33).flat_map(|x| (0..27).map(move |y| (x, y))) {
            let expected = if lit.pixel(x, y) == Some([255; 3]) { whole.pixel(x, y) } else { Some([0; 3]) };
            prop_assert_eq!(found.pixel(x, y), expected, "{}, {}", x, y);
        }
    }

    #[test]
    fn a_shaded_sprite_looks_as_if_covered(picture in any_picture(), at in (-30..60i32, -30..60i32), alpha: u8) {
        let sprite = Sprite::new(&picture);
        let mut expected = Surface::new(33, 27);
        sprite.blit(&mut expected.canvas(), at.0, at.1);
        let mut cover = Surface::new(33, 27);
        cover.set_color_key(Some([255, 0, 0]));
        cover.set_alpha(alpha.into());
        expected.blit(&cover, 0, 0);
        let mut found = Surface::new(33, 27);
        sprite.shaded(alpha).blit(&mut found.canvas(), at.0, at.1);
        prop_assert_eq!(found.pixels(), expected.pixels());
    }
}

#[test]
fn an_outline_is_the_thin_circle_and_lies_on_the_disc() {
    let size = 2 * 70 + 2;
    for radius in -1..70 {
        let center = (size / 2, size / 2);
        let mut expected = Surface::new(size as usize, size as usize);
        expected.draw_circle([9; 3], center, radius, 1);
        let mut disc = Surface::new(size as usize, size as usize);
        disc.draw_circle([9; 3], center, radius, 0);
        let mut found = Surface::new(size as usize, size as usize);
        let outline = circle_outline(radius);
        for (x, y) in &outline {
            let (x, y) = ((center.0 + x) as usize, (center.1 + y) as usize);
            assert_eq!(found.pixel(x, y), Some([0; 3]), "radius {radius}: twice");
            assert_eq!(disc.pixel(x, y), Some([9; 3]), "radius {radius}: off the disc");
            found.canvas().put(x as i64, y as i64, [9; 3]);
        }
        assert_eq!(found, expected, "radius {radius}");
    }
}

#[test]
fn the_bounds_of_a_sprite_are_tight() {
    let mut surface = Surface::new(10, 8);
    surface.set_color_key(Some([0; 3]));
    assert_eq!(Sprite::new(&surface).bounds(), Rect::default());
    surface.draw_rect([1; 3], Rect::new(3, 2, 4, 5), 0);
    assert_eq!(Sprite::new(&surface).bounds(), Rect::new(3, 2, 4, 5));
    surface.set_color_key(None);
    assert_eq!(Sprite::new(&surface).bounds(), Rect::new(0, 0, 10, 8));
}
