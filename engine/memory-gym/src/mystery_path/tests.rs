//! What the recorded traces of the rules do not have: features.

use std::sync::Arc;

use serde_json::{Value as Json, json};

use super::config::TILE;
use super::features::{BACKGROUND, FALLEN, PAST_PATH, PAST_SHIFT, STAMINA};
use super::path::GRID;
use super::{IDS, MysteryPath, State};
use crate::screen::{FRAME, SCREEN};
use endless_gym_core::envs::Environment;
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;

const RIGHT: i32 = 1;
const UP: i32 = 2;
const DOWN: i32 = 3;

/// An environment of the endless id with its generator.
struct Game {
    env: MysteryPath,
    random: Generator,
}

impl Game {
    fn new(options: &Json, seed: u64) -> Self {
        let (spec, variant) = &IDS[2];
        let parameters = spec.reset_parameters(options.as_object().unwrap()).unwrap();
        let assets = Arc::new(MysteryPath::assets(*variant, &parameters));
        let mut game = Game { env: MysteryPath::new(&assets), random: Generator::from_seed(seed) };
        game.env.reset(&assets, &mut game.random);
        game
    }

    fn step(&mut self, action: i32) {
        self.env.step(&[action], &mut self.random);
    }

    fn state(&self) -> &State {
        &self.env.state
    }

    fn features(&self) -> Vec<f32> {
        let mut features = vec![0.0; IDS[2].0.features.len()];
        self.env.features(&mut features);
        features
    }

    fn frame(&self) -> Vec<u8> {
        // The previous content must not matter.
        let mut frame = vec![77; FRAME.bytes()];
        MysteryPath::paint(self.env.shared(), &self.env.scene(), &mut Canvas::new(&mut frame, SCREEN, SCREEN));
        frame
    }
}

#[test]
fn features_show_a_fall_and_stamina() {
    let mut game = Game::new(&json!({ "stamina_level": 6, "show_stamina": true }), 3);
    for left in (1..6).rev() {
        game.step(0);
        assert_eq!(game.features()[STAMINA..STAMINA + 2], [1.0, left as f32 / 6.0]);
    }
    for (seed, visual_feedback) in [(0, true), (1, true), (2, false)] {
        let mut game = Game::new(&json!({ "visual_feedback": visual_feedback }), seed);
        let is_red = |game: &Game| game.frame().as_chunks::<3>().0.contains(&[255, 0, 0]);
        while !game.state().off_path {
            assert!(game.features()[FALLEN] == 0.0 && !is_red(&game));
            game.step(UP);
        }
        assert_eq!(game.features()[FALLEN], f32::from(u8::from(visual_feedback)));
        assert_eq!(is_red(&game), visual_feedback);
        game.step(0);
        assert!(game.features()[FALLEN] == 0.0 && !is_red(&game));
    }
}

#[test]
fn features_and_frame_show_the_same_past_path() {
    for offset in [5.0, 5.3, 2.5, 0.4] {
        // An agent of size 0 covers nothing.
        let options = json!({ "camera_offset_scale": offset, "show_background": true, "agent_scale": 0 });
        // Its path never leads left.
        let fits = |game: &Game| game.state().route.tiles().windows(2).all(|pair| pair[0].0 <= pair[1].0);
        let mut game = (0..).map(|seed| Game::new(&options, seed)).find(fits).unwrap();
        for number in 1..12 {
            let (x, y) = game.state().route.tiles()[number];
            while game.state().tile != (x, y) {
                game.step([UP, RIGHT, DOWN][(y - game.state().tile.1 + 1) as usize]);
            }
            let (frame, features) = (game.frame(), game.features());
            assert!((0.0..1.0).contains(&features[BACKGROUND]));
            for column in 0..=GRID {
                for row in 0..GRID {
                    let left = (column as f32 - features[PAST_SHIFT]) * TILE as f32;
                    let (x, y) = ((left + 2.0) as usize, (row * TILE + 1) as usize);
                    if left < 0.0 || x >= SCREEN - 2 {
                        continue;
                    }
                    let pixel = frame.as_chunks::<3>().0[x * SCREEN + y];
                    let seen = features[PAST_PATH + (column * GRID + row) as usize] == 1.0;
                    assert_eq!(seen, pixel == [255; 3], "offset {offset}, tile {number}, column {column}, row {row}");
                }
            }
        }
    }
}
