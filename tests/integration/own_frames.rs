//! Frames of any size and of 1, 3 or 4 channels, environments without frames, and actions of a box.

use endless_gym::batch::{BatchSection, Frames, PixelFormat};
use endless_gym::envs::{ActionSpace, Column, EnvSpec, ResetParameters, Task, Transition, box_action};
use endless_gym::pool::{Pool, PoolConfig, PoolError, Registry, RegistryError, ResetRequest, Threads};
use endless_gym::random::Generator;
use endless_gym::raster::{Canvas, FrameShape, Rect};
use serde::{Deserialize, Serialize};

use crate::support::player::Player;

const ID: &str = "Dot-v0";
const BOX: ActionSpace = ActionSpace::bounded(&[-1.0, -2.0], &[1.0, f32::INFINITY]);
const PLACE: &[Column] =
    &[Column { name: "place", description: "place" }, Column { name: "sum", description: "sum of the actions" }];

/// A dot at a place that each step draws.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Dot<const WIDTH: usize, const HEIGHT: usize, const CHANNELS: usize> {
    place: usize,
    sum: f32,
}

impl<const WIDTH: usize, const HEIGHT: usize, const CHANNELS: usize> Task for Dot<WIDTH, HEIGHT, CHANNELS> {
    type Parameters = ();

    fn spec() -> EnvSpec {
        let frame = FrameShape { width: WIDTH, height: HEIGHT, channels: CHANNELS };
        EnvSpec { frame: (CHANNELS > 0).then_some(frame), features: PLACE, ..EnvSpec::new(ID, "Look", BOX) }
    }

    fn parameters(_: &ResetParameters) {}

    fn reset(&mut self, _: &(), random: &mut Generator) {
        *self = Dot { place: random.integers(0, (WIDTH * HEIGHT) as i64) as usize, sum: 0.0 };
    }

    fn step(&mut self, _: &(), action: &[i32], random: &mut Generator) -> Transition {
        self.place = random.integers(0, (WIDTH * HEIGHT) as i64) as usize;
        self.sum += box_action(action).iter().sum::<f32>();
        Transition::default()
    }

    fn features(&self, _: &(), out: &mut [f32]) {
        out.copy_from_slice(&[self.place as f32, self.sum]);
    }

    fn paint(&self, _: &(), canvas: &mut Canvas<'_>) {
        canvas.draw_rect([1, 2, 3], Rect::new((self.place / HEIGHT) as i32, (self.place % HEIGHT) as i32, 1, 1), 0);
    }

    fn is_valid(&self, _: &()) -> bool {
        self.place < WIDTH * HEIGHT && self.sum.is_finite()
    }

    fn write_pixels(&self, _: &(), pixels: &mut [u8]) {
        pixels[self.place * CHANNELS..][..CHANNELS].copy_from_slice(&[1, 2, 3, 4][..CHANNELS]);
    }
}

/// Checks the shape and every byte of the frames in all formats, single and stacked.
fn frames_are_right<const WIDTH: usize, const HEIGHT: usize, const CHANNELS: usize>() {
    let registry = Registry::new().with::<Dot<WIDTH, HEIGHT, CHANNELS>>().unwrap();
    for (bits, stack) in (0..4).flat_map(|bits| [(bits, 1), (bits, 2)]) {
        let format = PixelFormat { grayscale: false, channels_first: bits & 1 != 0, row_major: bits & 2 != 0 };
        let config = PoolConfig::new(ID, 3).features(true).check_drawing(true).frames(Some(Frames { format, stack }));
        let mut player = Player::in_registry(&registry, &config, 1);
        player.reset(ResetRequest::Seed(1));
        let (first, second) = if format.row_major { (HEIGHT, WIDTH) } else { (WIDTH, HEIGHT) };
        let shape = if format.channels_first { [CHANNELS, first, second] } else { [first, second, CHANNELS] };
        let expected = if stack == 1 { shape.to_vec() } else { [vec![stack], shape.to_vec()].concat() };
        let section = player.pool.layout().section(BatchSection::Observation).unwrap();
        assert_eq!(section.shape(), expected);
        let length = WIDTH * HEIGHT * CHANNELS;
        for _ in 0..10 {
            player.step_all(0);
            let batch = player.batch();
            for (row, features) in
                batch.observation().chunks_exact(length * stack).zip(batch.features().chunks_exact(2))
            {
                let place = features[0] as usize;
                let (x, y) = (place / HEIGHT, place % HEIGHT);
                let pixel = if format.row_major { y * WIDTH + x } else { place };
                let newest = &row[length * (stack - 1)..];
                for channel in 0..CHANNELS {
                    let at = if format.channels_first {
                        channel * WIDTH * HEIGHT + pixel
                    } else {
                        pixel * CHANNELS + channel
                    };
                    assert_eq!(newest[at], 1 + channel as u8, "{format:?}");
                }
                assert_eq!(newest.iter().filter(|byte| **byte != 0).count(), CHANNELS);
            }
        }
        let plain = PoolConfig::new(ID, 3).features(true);
        let [mut with, mut without] = [Some(Frames::default()), None]
            .map(|frames| Player::in_registry(&registry, &plain.clone().frames(frames), 1));
        for player in [&mut with, &mut without] {
            player.reset(ResetRequest::Seed(1));
            player.step_all(0);
        }
        assert_eq!(without.pool.frame(1).unwrap(), with.batch().observation().chunks(length).nth(1).unwrap());
        let view = player.pool.ground_truth_view(0).unwrap();
        assert_eq!((view.width, view.height, view.pixels.len()), (4 * WIDTH, 4 * HEIGHT, 16 * 3 * WIDTH * HEIGHT));
        assert!(view.pixels.iter().any(|byte| *byte != 0));
        let snapshot = player.pool.snapshot(1).unwrap();
        player.step_all(0);
        player.pool.restore(1, &snapshot).unwrap();
        player.observe();
    }
}

#[test]
fn frames_have_any_size_and_1_3_or_4_channels() {
    frames_are_right::<5, 7, 1>();
    frames_are_right::<5, 7, 3>();
    frames_are_right::<5, 7, 4>();
    frames_are_right::<1, 1, 3>();
    // Taller than a mask of dirty rows.
    frames_are_right::<3, 200, 3>();
    frames_are_right::<200, 129, 4>();
}

#[test]
fn an_environment_without_frames_always_has_its_features() {
    let registry = Registry::new().with::<Dot<5, 7, 0>>().unwrap();
    let mut player = Player::in_registry(&registry, &PoolConfig::new(ID, 2), 1);
    player.reset(ResetRequest::Seed(1));
    let numbers = [0.5, -1.5, 0.25, 1e30_f32].map(|number| number.to_bits().cast_signed());
    player.step(&numbers);
    let batch = player.batch();
    assert!(batch.observation().is_empty());
    assert_eq!([batch.features()[1], batch.features()[3]], [-1.0, 1e30]);
    let not_a_number = [0.0, f32::NAN, 0.0, 0.0].map(|number: f32| number.to_bits().cast_signed());
    let error = player.pool.step(&not_a_number, &mut player.blocks).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the action of environment 0 must be in Box([-1.0, -2.0], [1.0, inf]), got [0.0, NaN]"
    );
    assert!(matches!(player.pool.ground_truth_view(0), Err(PoolError::NoFrame { id: ID })));
    assert!(matches!(player.pool.frame(0), Err(PoolError::NoFrame { id: ID })));
}

#[test]
fn contradictory_specifications_are_refused() {
    let add = |result: Result<Registry, RegistryError>| result.unwrap_err().to_string();
    assert!(add(Registry::new().with::<Dot<0, 7, 3>>()).contains("width and height of 1 to 4096"));
    assert!(add(Registry::new().with::<Dot<5, 5000, 3>>()).contains("got FrameShape"));
    assert!(add(Registry::new().with::<Dot<5, 7, 2>>()).contains("1, 3 or 4 channels"));
    let registry = Registry::new().with::<Dot<5, 7, 4>>().unwrap();
    let format = PixelFormat { grayscale: true, ..PixelFormat::default() };
    let config = PoolConfig::new(ID, 1).frames(Some(Frames { format, stack: 1 }));
    let result = Pool::new(&registry, &config, &Threads::new(1).unwrap());
    assert!(matches!(result, Err(PoolError::Grayscale { id: ID, channels: 4 })));
}
