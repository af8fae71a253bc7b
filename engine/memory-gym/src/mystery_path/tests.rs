use std::sync::Arc;

use serde_json::{Map, Value as Json, json};

use super::config::TILE;
use super::features::{BACKGROUND, FALLEN, PAST_PATH, PAST_SHIFT, STAMINA};
use super::path::{GRID, Tile};
use super::{IDS, MysteryPath, State, Variant};
use crate::screen::{FRAME, SCREEN};
use endless_gym_core::envs::{EnvSpec, Environment, Transition};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;

/// Actions of the endless id.
const RIGHT: i32 = 1;
const UP: i32 = 2;
const DOWN: i32 = 3;

/// One environment with its generator.
struct Game {
    spec: &'static EnvSpec,
    env: MysteryPath,
    random: Generator,
}

impl Game {
    fn new(number: usize, options: &Json, seed: u64) -> Self {
        let (spec, variant) = &IDS[number];
        let given: Map<String, Json> = options.as_object().unwrap().clone();
        let parameters = spec.reset_parameters(&given).unwrap();
        let assets = Arc::new(MysteryPath::assets(*variant, &parameters));
        let mut game = Game { spec, env: MysteryPath::new(&assets), random: Generator::from_seed(seed) };
        game.env.reset(&assets, &mut game.random);
        game
    }

    fn endless(options: &Json, seed: u64) -> Self {
        Game::new(2, options, seed)
    }

    fn step(&mut self, action: &[i32]) -> Transition {
        self.env.step(action, &mut self.random)
    }

    fn state(&self) -> &State {
        &self.env.state
    }

    fn features(&self) -> Vec<f32> {
        let mut features = vec![0.0; self.spec.features.len()];
        self.env.features(&mut features);
        features
    }

    fn info(&self) -> [f64; 3] {
        let mut info = [0.0; 3];
        self.env.info(&mut info);
        info
    }

    fn frame(&self) -> Vec<u8> {
        // The previous content must not matter.
        let mut frame = vec![77; FRAME.bytes()];
        MysteryPath::paint(self.env.shared(), &self.env.scene(), &mut Canvas::new(&mut frame, SCREEN, SCREEN));
        frame
    }

    /// Moves to a neighbouring tile, on the path or off it, and sums the rewards.
    fn walk_to(&mut self, (x, y): Tile) -> Transition {
        let mut sum = Transition::default();
        while self.state().tile != (x, y) && !self.state().off_path && !sum.terminated {
            let (from_x, from_y) = self.state().tile;
            let towards = |offset: i32| [1, 0, 2][(offset.signum() + 1) as usize];
            let action = match self.env.assets.config.variant {
                Variant::Free => vec![towards(x - from_x), towards(y - from_y)],
                Variant::Grid => panic!("the grid's agent turns"),
                Variant::Endless => vec![[UP, RIGHT, DOWN][(y - from_y + 1) as usize]],
            };
            let transition = self.step(&action);
            sum.reward += transition.reward;
            sum.terminated |= transition.terminated;
        }
        sum
    }

    /// A tile above or below the path's tile `number` that is not on the path.
    fn beside(&self, number: usize) -> Option<Tile> {
        let (x, y) = self.state().route.tiles()[number];
        let free = |tile: &Tile| (0..GRID).contains(&tile.1) && self.state().route.index(*tile).is_none();
        [(x, y - 1), (x, y + 1)].into_iter().find(free)
    }
}

/// A game whose path never leads left, with free tiles next to the tiles of these numbers.
fn endless_with_room(options: &Json, numbers: &[usize]) -> Game {
    let fits = |game: &Game| {
        let tiles = game.state().route.tiles();
        tiles.windows(2).all(|pair| pair[0].0 <= pair[1].0) && numbers.iter().all(|n| game.beside(*n).is_some())
    };
    (0..).map(|seed| Game::endless(options, seed)).find(fits).unwrap()
}

#[test]
fn the_path_leads_to_the_goal_and_rewards_each_tile_once() {
    let mut game = Game::new(0, &json!({ "reward_path_progress": 1.0, "reward_goal": 100.0, "max_steps": -1 }), 5);
    let tiles = game.state().route.tiles().to_vec();
    game.walk_to(tiles[1]);
    assert_eq!(game.info(), [0.0, 0.0, 1.0 / (tiles.len() - 1) as f64]);
    game.walk_to(tiles[0]);
    let mut reward = 1.0;
    for (number, tile) in tiles.iter().enumerate().skip(1) {
        let transition = game.walk_to(*tile);
        reward += transition.reward;
        assert_eq!(transition.terminated, number == tiles.len() - 1);
    }
    assert_eq!(reward, 100.0 + (tiles.len() - 2) as f64);
    assert_eq!(game.info(), [1.0, 0.0, 1.0]);
}

#[test]
fn a_fall_shows_a_cross_and_leads_back() {
    let options = json!({ "reward_fall_off": -1.0, "cardinal_origin_choice": [0] });
    for (seed, visual_feedback) in [(0, true), (1, true), (2, false)] {
        let mut options = options.clone();
        options["visual_feedback"] = json!(visual_feedback);
        let mut game = Game::new(0, &options, seed);
        let start = game.state().agent.position;
        let off = game.beside(0).unwrap();
        assert_eq!(game.walk_to(off), Transition { reward: -1.0, ..Transition::default() });
        assert_eq!(game.features()[FALLEN], f32::from(u8::from(visual_feedback)));
        let is_red = |frame: &[u8]| frame.as_chunks::<3>().0.contains(&[255, 0, 0]);
        assert_eq!(is_red(&game.frame()), visual_feedback);
        game.step(&[2, 2]);
        assert_eq!(game.state().agent.position, start);
        assert!(!is_red(&game.frame()));
        assert_eq!(game.info()[..2], [0.0, 1.0]);
    }
}

#[test]
fn an_endless_episode_ends_with_a_fall_before_the_farthest_column() {
    let mut game = endless_with_room(&json!({ "stamina_level": 1000 }), &[0]);
    let tiles = game.state().route.tiles().to_vec();
    let first = game.beside(0).unwrap();
    assert!(!game.walk_to(first).terminated, "no column is before the first one");
    game.step(&[0]);
    for tile in tiles.iter().take_while(|tile| tile.0 < 2) {
        assert!(!game.walk_to(*tile).terminated);
    }
    let farther = tiles.iter().find(|tile| tile.0 == 2).unwrap();
    game.walk_to(*farther);
    // A fall in the farthest column leads back to the start, where the next fall ends the episode.
    while !game.state().off_path {
        let (x, y) = game.state().tile;
        assert!(!game.walk_to((x, y - 1)).terminated);
    }
    game.step(&[0]);
    assert_eq!(game.state().endless.farthest(), 2);
    assert!(game.walk_to(first).terminated);
}

#[test]
fn an_endless_episode_ends_with_a_second_fall_at_the_same_tile() {
    let mut game = endless_with_room(&json!({ "stamina_level": 1000 }), &[0]);
    let off = game.beside(0).unwrap();
    assert!(!game.walk_to(off).terminated);
    game.step(&[0]);
    assert!(game.walk_to(off).terminated);
    assert_eq!(game.state().endless_info(), [2.0, 0.0, 0.0]);
}

#[test]
fn stamina_runs_out_unless_there_is_progress() {
    let options = json!({ "stamina_level": 6, "show_stamina": true });
    let mut game = Game::endless(&options, 3);
    for left in (1..6).rev() {
        assert!(!game.step(&[0]).terminated);
        assert_eq!(game.features()[STAMINA..STAMINA + 2], [1.0, left as f32 / 6.0]);
    }
    assert!(game.step(&[0]).terminated);
    let mut game = endless_with_room(&options, &[]);
    let tiles = game.state().route.tiles().to_vec();
    for tile in &tiles[..10] {
        assert!(!game.walk_to(*tile).terminated);
    }
}

#[test]
fn the_route_is_extended_and_kept() {
    let mut game = endless_with_room(&json!({ "agent_speed": 12.0 }), &[]);
    let known = game.state().route.tiles().to_vec();
    let mut number = 0;
    while game.state().endless.farthest() < 100 {
        number += 1;
        let next = game.state().route.tiles()[number];
        if next.0 < game.state().tile.0 {
            break;
        }
        assert!(!game.walk_to(next).terminated);
    }
    assert!(number > 2 * GRID as usize);
    assert!(game.state().route.tiles().starts_with(&known));
    assert_eq!(game.state().tiles_visited as usize, game.state().route.index(game.state().tile).unwrap());
}

#[test]
fn features_and_frame_show_the_same_past_path() {
    for offset in [5.0, 5.3, 2.5, 0.4] {
        // An agent of size 0 covers nothing.
        let options = json!({ "camera_offset_scale": offset, "show_background": true, "agent_scale": 0 });
        let mut game = endless_with_room(&options, &[]);
        for number in 1..12 {
            let tile = game.state().route.tiles()[number];
            game.walk_to(tile);
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
