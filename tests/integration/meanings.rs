//! Tests that the registry's descriptions of actions and ground truth match the rules.

use std::collections::BTreeSet;

use crate::support::player::Player;
use endless_gym::batch::Batch;
use endless_gym::envs::EnvSpec;
use endless_gym::memory_gym;
use endless_gym::pool::{PoolConfig, ResetOptions, ResetRequest};
use serde_json::json;

/// One environment, with its features and its ground truth by name.
struct Named(Player);

impl Named {
    /// One environment at the start of an episode; in Mortar Mayhem, after the commands were shown, so that the agent
    /// may move.
    fn new(spec: &EnvSpec, seed: u64, options: serde_json::Value) -> Self {
        let mut options = options.as_object().unwrap().clone();
        if spec.parameters.iter().any(|parameter| parameter.name == "command_show_delay") {
            // Without pauses between the commands, the first frame without a command follows the last one.
            options.insert("command_show_delay".to_owned(), json!([0]));
        }
        let options = ResetOptions::Shared(options);
        let config = PoolConfig::new(spec.id, 1).options(options).features(true);
        let mut player = Named(Player::new(&config));
        player.0.reset(ResetRequest::Seed(seed));
        while player.any_feature("command_") {
            player.step(&vec![0; spec.actions.len()]);
        }
        player
    }

    fn step(&mut self, action: &[i32]) {
        self.0.step(action);
    }

    fn batch(&self) -> Batch<'_> {
        self.0.batch()
    }

    fn feature(&self, name: &str) -> f32 {
        let place = self.0.pool.spec().features.iter().position(|column| column.name == name);
        self.batch().features()[place.unwrap_or_else(|| panic!("no feature {name}"))]
    }

    fn any_feature(&self, prefix: &str) -> bool {
        let columns = self.0.pool.spec().features.iter().zip(self.batch().features());
        columns.into_iter().any(|(column, value)| column.name.starts_with(prefix) && *value > 0.0)
    }

    fn truth(&self, name: &str) -> f64 {
        let place = self.0.pool.spec().ground_truth.iter().position(|column| column.name == name);
        self.batch().ground_truth()[place.unwrap_or_else(|| panic!("no ground truth {name}"))]
    }

    fn heading(&self) -> [f32; 2] {
        ["heading_x", "heading_y"].map(|name| self.feature(name).round())
    }

    fn place(&self) -> [f32; 2] {
        ["agent_x", "agent_y"].map(|name| self.feature(name))
    }
}

/// The direction in which an action of this name moves, as a unit vector.
fn direction(name: &str) -> [f32; 2] {
    match name {
        "nothing" => [0.0, 0.0],
        "left" => [-1.0, 0.0],
        "right" => [1.0, 0.0],
        "up" => [0.0, -1.0],
        "down" => [0.0, 1.0],
        other => panic!("an action {other}"),
    }
}

#[test]
fn every_action_and_column_has_a_description() {
    for spec in memory_gym().specs() {
        let choices: Vec<_> = spec.actions.iter().map(|branch| branch.choices.len() as i32).collect();
        assert_eq!(choices, spec.action_space.branches(), "{}", spec.id);
        let player = Named::new(spec, 1, json!({}));
        assert_eq!(spec.ground_truth.len(), player.batch().ground_truth().len(), "{}", spec.id);
        assert_eq!(spec.features.len(), player.batch().features().len(), "{}", spec.id);
        let columns = spec.ground_truth.iter().chain(spec.features).map(|column| (column.name, column.description));
        let unique: BTreeSet<_> = spec.features.iter().map(|column| column.name).collect();
        assert_eq!(unique.len(), spec.features.len(), "{}: names of features are unique", spec.id);
        let choices = spec.actions.iter().flat_map(|branch| branch.choices);
        for (name, description) in columns.chain(choices.map(|choice| (choice.name, choice.description))) {
            assert!(!name.is_empty() && description.len() > 5, "{}: {name}", spec.id);
        }
    }
}

#[test]
fn actions_move_the_agent_as_their_names_say() {
    for spec in memory_gym().specs() {
        let is_grid = spec.actions.iter().any(|branch| branch.choices.iter().any(|choice| choice.name == "ahead"));
        let follows_a_path = spec.id == "Endless-MysteryPath-v0";
        let mut moved = 0;
        for (number, branch) in spec.actions.iter().enumerate().filter(|_| !is_grid) {
            for (value, choice) in branch.choices.iter().enumerate() {
                for seed in 0..20 {
                    let mut player = Named::new(spec, seed, json!({}));
                    let mut action = vec![0; spec.actions.len()];
                    // The first frame may show the agent one pixel off, as in the original.
                    player.step(&action);
                    let (place, heading) = (player.place(), player.heading());
                    action[number] = value as i32;
                    player.step(&action);
                    let [x, y] = direction(choice.name);
                    let named = format!("{}, {} {value}, seed {seed}", spec.id, branch.name);
                    assert_eq!(player.heading(), if choice.name == "nothing" { heading } else { [x, y] }, "{named}");
                    let [dx, dy] = [player.place()[0] - place[0], player.place()[1] - place[1]];
                    // The border stops the agent or moves it to the other side; on the endless path, the screen
                    // scrolls.
                    let jumped = dx.abs() > 0.5 || dy.abs() > 0.5;
                    if !(jumped || follows_a_path && choice.name == "right") {
                        assert!(dx * x >= 0.0 && dy * y >= 0.0, "{named}: {dx} {dy}");
                        assert!((x != 0.0 || dx == 0.0) && (y != 0.0 || dy == 0.0), "{named}: {dx} {dy}");
                        moved += usize::from(dx != 0.0 || dy != 0.0);
                    }
                }
            }
        }
        assert!(is_grid || moved > 20, "{}: {moved}", spec.id);
    }
}

#[test]
fn grid_actions_turn_and_walk() {
    let mut walked = 0;
    for spec in memory_gym().specs().filter(|spec| spec.id.contains("Grid")) {
        let names: Vec<_> = spec.actions[0].choices.iter().map(|choice| choice.name).collect();
        assert_eq!(names, ["nothing", "left", "right", "ahead"]);
        for seed in 0..20 {
            for turns in 0..4 {
                let mut player = Named::new(spec, seed, json!({}));
                let start = player.place();
                let mut heading = player.heading();
                for turn in 0..turns {
                    let [x, y] = heading;
                    // The second coordinate grows downwards.
                    let (value, turned) = if turn % 2 == 0 { (2, [-y, x]) } else { (1, [y, -x]) };
                    let (value, turned) = if seed % 2 == 0 { (value, turned) } else { (1, [y, -x]) };
                    player.step(&[value]);
                    heading = turned.map(|part| part + 0.0);
                    assert_eq!(player.heading().map(|part| part + 0.0), heading, "{}, seed {seed}", spec.id);
                    assert_eq!(player.place(), start, "a turn does not move");
                }
                player.step(&[0]);
                assert_eq!((player.place(), player.heading().map(|part| part + 0.0)), (start, heading));
                player.step(&[3]);
                let [dx, dy] = [player.place()[0] - start[0], player.place()[1] - start[1]];
                assert_eq!(
                    dx.abs() + dy.abs() > 0.0,
                    dx * heading[0] + dy * heading[1] > 0.0,
                    "ahead, or at the border"
                );
                walked += usize::from(dx != 0.0 || dy != 0.0);
            }
        }
    }
    assert!(walked > 100, "{walked}");
}

#[test]
fn the_ground_truth_of_endless_mortar_mayhem_is_the_tile_that_does_not_burn() {
    let spec = memory_gym().spec("Endless-MortarMayhem-v0").unwrap();
    let mut burnt = 0;
    for seed in 0..20 {
        let mut player = Named::new(spec, seed, json!({}));
        for _ in 0..60 {
            player.step(&[0, 0]);
            if player.feature("burning") == 1.0 {
                burnt += 1;
                for (truth, feature) in [("target_x", "safe_x"), ("target_y", "safe_y")] {
                    assert!((player.truth(truth) - f64::from(player.feature(feature))).abs() < 1e-6, "{truth}");
                }
            }
        }
    }
    assert!(burnt > 20, "{burnt}");
}

#[test]
fn the_ground_truth_of_endless_searing_spotlights_is_the_position_of_agent_and_coin() {
    let spec = memory_gym().spec("Endless-SearingSpotlights-v0").unwrap();
    let pairs = [("agent_x", "agent_x"), ("agent_y", "agent_y"), ("coin_x", "coin_0_x"), ("coin_y", "coin_0_y")];
    let mut player = Named::new(spec, 3, json!({"agent_visible": true, "coins_visible": true}));
    for step in 0..40 {
        player.step(&[step % 3, (step / 3) % 3]);
        for (truth, feature) in pairs {
            assert!((player.truth(truth) - f64::from(player.feature(feature))).abs() < 1e-6, "{truth}, step {step}");
        }
    }
    let without_coin = Named::new(spec, 3, json!({"coin_enabled": false}));
    assert_eq!(["coin_x", "coin_y"].map(|name| without_coin.truth(name)), [0.0, 0.0]);
}

#[test]
fn the_ground_truth_of_endless_mystery_path_is_the_next_action_along_the_path() {
    let spec = memory_gym().spec("Endless-MysteryPath-v0").unwrap();
    let names: Vec<_> = spec.actions[0].choices.iter().map(|choice| choice.name).collect();
    for seed in 0..10 {
        let mut player = Named::new(spec, seed, json!({"agent_speed": 12.0}));
        let mut turns = 0;
        for step in 0..30 {
            let ones: Vec<_> = spec.ground_truth.iter().filter(|column| player.truth(column.name) == 1.0).collect();
            let [next] = ones[..] else { panic!("{ones:?}") };
            let action = names.iter().position(|name| *name == next.name).unwrap() as i32;
            turns += usize::from(next.name != "right");
            player.step(&[action]);
            assert_eq!(player.feature("fallen"), 0.0, "seed {seed}, step {step}, {}", next.name);
        }
        assert!(turns > 0, "seed {seed}");
    }
}
