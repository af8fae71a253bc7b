//! Tests what the recorded traces do not cover: options that the original cannot play, limits, features, snapshots.

use std::sync::{Arc, LazyLock};

use serde_json::{Map, Value as Json, json};

use super::features::{AGENT, COIN, EXIT, HEALTH, HIT, LAST_ACTION, LIGHT, SPOTLIGHT};
use super::{Assets, IDS, MAX_SPOTLIGHTS, SearingSpotlights, Variant};
use crate::screen::{FRAME, SCREEN};
use endless_gym_core::envs::{EnvSpec, Environment};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;

static FINITE: LazyLock<&EnvSpec> = LazyLock::new(|| &IDS[0].0);
static ENDLESS: LazyLock<&EnvSpec> = LazyLock::new(|| &IDS[1].0);

fn assets(spec: &'static EnvSpec, options: &Map<String, Json>) -> Arc<Assets> {
    let parameters = spec.reset_parameters(options).unwrap();
    let variant = Variant { endless: spec.id == ENDLESS.id };
    Arc::new(SearingSpotlights::assets(variant, &parameters))
}

/// An environment after its reset, and its generator.
fn started(spec: &'static EnvSpec, options: &Json, seed: u64) -> (SearingSpotlights, Generator) {
    let assets = assets(spec, options.as_object().unwrap());
    let mut environment = SearingSpotlights::new(&assets);
    let mut random = Generator::from_seed(seed);
    environment.reset(&assets, &mut random);
    (environment, random)
}

fn features(environment: &SearingSpotlights) -> Vec<f32> {
    let mut features = vec![f32::NAN; FINITE.features.len()];
    environment.features(&mut features);
    features
}

fn frame(environment: &SearingSpotlights, before: u8) -> Vec<u8> {
    let mut frame = vec![before; FRAME.bytes()];
    let canvas = &mut Canvas::new(&mut frame, SCREEN, SCREEN);
    SearingSpotlights::paint(environment.shared(), &environment.scene(), canvas);
    frame
}

/// The agent stands still for some steps.
fn stand(environment: &mut SearingSpotlights, random: &mut Generator, steps: usize) {
    for _ in 0..steps {
        environment.step(&[0, 0], random);
    }
}

/// The agent walks towards a place; returns the last reward and whether the episode ended.
fn walk(environment: &mut SearingSpotlights, random: &mut Generator, to: (i32, i32)) -> (f64, bool) {
    for _ in 0..60 {
        let (x, y) = environment.state.agent.position;
        let towards = |distance: i32| if distance.abs() < 3 { 0 } else { 1 + i32::from(distance > 0) };
        let transition = environment.step(&[towards(to.0 - x), towards(to.1 - y)], random);
        if transition.terminated || transition.reward > 0.0 {
            return (transition.reward, transition.terminated);
        }
    }
    panic!("nothing at {to:?}");
}

#[test]
fn without_an_exit_the_last_coin_wins() {
    let options = json!({"use_exit": false, "num_coins": [2], "initial_spawns": 0, "num_spawns": 0});
    let (mut environment, mut random) = started(&FINITE, &options, 3);
    assert_eq!(environment.state.exit, None);
    let coin = environment.state.coins[0];
    assert_eq!(walk(&mut environment, &mut random, coin), (0.25, false));
    let mut info = [0.0; 4];
    environment.info(&mut info);
    assert_eq!(info, [1.0, 0.5, 0.0, 0.5]);
    let coin = environment.state.coins[0];
    assert_eq!(walk(&mut environment, &mut random, coin), (0.25, true));
    environment.info(&mut info);
    assert_eq!(info, [1.0; 4]);
}

#[test]
fn without_coins_the_exit_is_open() {
    let options = json!({"num_coins": [0], "initial_spawns": 0, "num_spawns": 0});
    let (mut environment, mut random) = started(&FINITE, &options, 3);
    let exit = environment.state.exit.unwrap().location;
    assert_eq!(features(&environment)[EXIT + 3], 0.0);
    environment.step(&[0, 0], &mut random);
    assert_eq!(features(&environment)[EXIT + 3], 1.0);
    assert_eq!(walk(&mut environment, &mut random, exit), (1.0, true));
    let mut info = [f64::NAN; 4];
    environment.info(&mut info);
    assert_eq!((info[0], info[2], info[3]), (1.0, 1.0, 1.0));
    assert!(info[1].is_nan(), "0 of 0 coins, which is NaN in the original");
    assert!(FINITE.info[1].description.ends_with("; NaN if the episode had no coins"));
}

#[test]
fn without_coins_and_exit_only_time_ends_the_episode() {
    let options = json!({"num_coins": [0], "use_exit": false, "spot_damage": 0.0, "max_steps": 50});
    let (mut environment, mut random) = started(&FINITE, &options, 3);
    let ends: Vec<bool> = (0..50).map(|_| environment.step(&[0, 0], &mut random).terminated).collect();
    assert_eq!(ends.iter().position(|end| *end), Some(49));
}

#[test]
fn spotlights_are_limited() {
    let options = json!({"initial_spawns": 990, "spawn_interval": 0, "spot_min_speed": 0.0, "spot_max_speed": 0.0});
    let (mut environment, mut random) = started(&ENDLESS, &options, 3);
    stand(&mut environment, &mut random, 20);
    assert_eq!(environment.state.spotlights.len(), MAX_SPOTLIGHTS);
}

#[test]
fn features_agree_with_the_frame() {
    let (mut environment, mut random) = started(&ENDLESS, &json!({"initial_spawns": 0}), 8);
    let lit = features(&environment);
    let (x, y) = environment.state.agent.position;
    assert_eq!(lit[AGENT..AGENT + 3], [1.0, x as f32 / 84.0, y as f32 / 84.0]);
    assert_eq!((lit[COIN], lit[LIGHT], lit[HEALTH]), (1.0, 1.0, 1.0));
    environment.step(&[0, 2], &mut random);
    assert_eq!(features(&environment)[LAST_ACTION..LAST_ACTION + 2], [0.0, 0.0]);
    environment.step(&[0, 0], &mut random);
    assert_eq!(features(&environment)[LAST_ACTION..LAST_ACTION + 2], [0.0, 1.0]);
    stand(&mut environment, &mut random, 6);
    let dark = features(&environment);
    assert_eq!((dark[AGENT], dark[COIN], dark[LIGHT], dark[SPOTLIGHT]), (0.0, 0.0, 0.0, 0.0));
    assert!(frame(&environment, 1).chunks_exact(SCREEN * 3).all(|column| column[12..].iter().all(|value| *value == 0)));

    // A spotlight that covers the screen lights everything, and damages the agent.
    let options = json!({"spot_min_radius": 200.0, "spot_max_radius": 200.0, "light_dim_off_duration": 0,
                         "spot_min_speed": 0.1, "spot_max_speed": 0.1});
    let (mut environment, mut random) = started(&ENDLESS, &options, 8);
    stand(&mut environment, &mut random, 5);
    let hit = features(&environment);
    assert_eq!((hit[AGENT], hit[HIT], hit[LIGHT]), (1.0, 1.0, 0.0));
    assert!(hit[HEALTH] < 1.0 && hit[SPOTLIGHT] > 2.0);
}

#[test]
fn a_width_beyond_32_bits_wraps() {
    // Red columns that `pygame.draw.rect` of pygame 2.4 paints for a bar of this `width`.
    for (width, red) in [(41_i64, 41), (1 << 30, 84), (1 << 31, 0), ((1 << 32) - 5, 0), ((1 << 32) + 5, 5)] {
        let damage = (width as f64 + 0.5) / 42.0;
        let options = json!({"spot_min_radius": 200.0, "spot_max_radius": 200.0, "spot_min_speed": 0.1,
                             "spot_max_speed": 0.1, "agent_health": 1.0, "spot_damage": damage});
        let (mut environment, mut random) = started(&FINITE, &options, 8);
        let mut steps = 0;
        while !environment.state.hit {
            environment.step(&[0, 0], &mut random);
            steps += 1;
            assert!(steps < 50);
        }
        assert_eq!(environment.state.red_columns, red, "{width}");
    }
}

/// Plays with as many spotlights as `initial_spawns`, and repaints each frame from an earlier frame.
fn repaint_episodes(spec: &'static EnvSpec, options: &Json, seed: u64) {
    let (mut environment, mut random) = started(spec, options, seed);
    let assets = Arc::clone(&environment.assets);
    let mut shown = environment.scene();
    let mut repainted = frame(&environment, 0);
    for step in 0..120 {
        // Some actions do not move the agent, so that objects stay where they are while the light changes.
        let action = [random.integers(0, 3) as i32, random.integers(0, 3) as i32 * (step / 8 % 2)];
        if environment.step(&action, &mut random).terminated {
            environment.reset(&assets, &mut random);
        }
        if step % 7 == 3 {
            continue;
        }
        let scene = environment.scene();
        scene.repaint(&shown, &assets, &mut Canvas::new(&mut repainted, SCREEN, SCREEN));
        assert!(repainted == frame(&environment, 0), "{} {options}, step {step}: {shown:?} to {scene:?}", spec.id);
        shown = scene;
    }
}

#[test]
fn repainted_frame_equals_frame_painted_in_full() {
    let views = [
        json!({}),
        json!({"light_threshold": 200, "light_dim_off_duration": 3}),
        json!({"black_background": true}),
        json!({"agent_visible": true, "coins_visible": true, "agent_health": 3.0}),
        json!({"light_dim_off_duration": 0, "agent_scale": 1.0, "coin_scale": 1.0}),
    ];
    let lights = [
        json!({"spot_max_speed": 0.02}),
        json!({"initial_spawns": 25, "spot_max_speed": 0.02, "spot_damage": 0.01}),
        json!({"initial_spawns": 60, "spot_max_speed": 0.02, "spot_damage": 0.0}),
        json!({"initial_spawns": 12, "spot_min_radius": 1.0, "spot_max_radius": 90.0, "spot_damage": 0.3}),
        json!({"initial_spawns": 6, "spot_min_speed": 0.01, "spot_max_speed": 0.1, "num_spawns": 1000}),
    ];
    for (spec, _) in IDS.iter() {
        for (view, light) in views.iter().flat_map(|view| lights.iter().map(move |light| (view, light))) {
            let mut options = view.as_object().unwrap().clone();
            options.extend(light.as_object().unwrap().clone());
            options.retain(|name, _| spec.parameters.iter().any(|parameter| parameter.name == name));
            repaint_episodes(spec, &Json::from(options), 7);
        }
    }
}
