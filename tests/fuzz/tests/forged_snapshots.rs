//! Forged snapshots: every number of a snapshot is set to extreme values, with a valid checksum. Each snapshot must be
//! refused or playable, without a panic or a hang.

use ciborium::Value;
use endless_gym_core::envs::{EnvSpec, ParameterKind};
use endless_gym_core::pool::{Seeding, SnapshotError};
use endless_gym_fuzz::registry;
use endless_gym_fuzz::snapshots::{Game, Outcome, at, extremes, paths, seedings};
use serde_json::{Map, Value as Json};

/// Number of items of a forged list, more than any list gets by playing within a test.
const MANY: usize = 100_000;

/// The environments of Memory Gym, and one level of each of POPGym: the levels differ in numbers only.
fn specs() -> impl Iterator<Item = &'static EnvSpec> {
    registry().specs().filter(|spec| !spec.id.contains("Easy") && !spec.id.contains("Hard"))
}

#[test]
fn long_lists_are_refused_or_played() {
    for spec in specs() {
        let mut game = Game::new(spec, Seeding::Continue { seed: Some(3) }, Map::new());
        game.play(45);
        let mut content = game.content();
        for path in paths(&mut content) {
            let mut forged = content.clone();
            let Value::Array(items) = at(&mut forged, &path) else { continue };
            let Some(item) = items.last().cloned() else { continue };
            items.resize(MANY, item);
            game.try_to_play(&forged);
        }
        if spec.id.contains("SearingSpotlights") {
            for name in ["coins", "spotlights", "lit"] {
                let mut forged = content.clone();
                let Value::Array(items) = field(field(&mut forged, "state"), name) else { panic!("{name} is no list") };
                let item = items.last().cloned().unwrap_or_else(|| panic!("{name} is empty"));
                items.resize(MANY, item);
                assert!(matches!(game.restore(&forged), Some(Err(SnapshotError::State(_)))), "{name}");
            }
        }
    }
}

/// Reset parameters with every flag set.
fn all_flags(spec: &EnvSpec) -> Map<String, Json> {
    let flags = spec.parameters.iter().filter(|parameter| matches!(parameter.kind, ParameterKind::Bool { .. }));
    flags.map(|parameter| (parameter.name.to_owned(), Json::from(true))).collect()
}

#[test]
fn extreme_numbers_are_refused_or_played() {
    for (spec, seeding) in specs().zip(seedings().into_iter().cycle()) {
        let (mut refused, mut played) = (0, 0);
        // The second time with every flag turned on.
        for (steps, options) in [(0, Map::new()), (45, all_flags(spec))] {
            let mut game = Game::new(spec, seeding.clone(), options);
            game.play(steps);
            let mut content = game.content();
            for path in paths(&mut content) {
                for extreme in extremes() {
                    let mut forged = content.clone();
                    *at(&mut forged, &path) = extreme;
                    match game.try_to_play(&forged) {
                        Outcome::NotEncodable => {}
                        Outcome::Refused => refused += 1,
                        Outcome::Played => played += 1,
                    }
                }
            }
            assert_eq!(game.restore(&content), Some(Ok(())), "what was not forged is not refused");
        }
        assert!(refused > 50 && played > 50, "{}: {refused} refused, {played} played", spec.id);
    }
}

fn field<'a>(value: &'a mut Value, name: &str) -> &'a mut Value {
    let Value::Map(entries) = value else { panic!("no fields in {value:?}") };
    entries.iter_mut().find(|(key, _)| key.as_text() == Some(name)).map(|(_, value)| value).unwrap()
}

#[test]
fn an_even_increment_is_refused() {
    // PCG64 with state 0 and increment 0 returns only zeros, which rejection sampling redraws forever.
    let spec = registry().spec("MysteryPath-v0").unwrap();
    let mut game = Game::new(spec, Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(3) }, Map::new());
    let content = game.content();
    for increment in [0, 2, u64::MAX - 1] {
        let mut forged = content.clone();
        *field(field(&mut forged, "random"), "increment") = Value::from(increment);
        assert!(matches!(game.restore(&forged), Some(Err(SnapshotError::Content(_)))), "{increment}");
        let mut forged = content.clone();
        *field(field(field(field(&mut forged, "seeds"), "Range"), "draws"), "increment") = Value::from(increment);
        assert!(matches!(game.restore(&forged), Some(Err(SnapshotError::Content(_)))), "seeds: {increment}");
    }
    assert_eq!(game.restore(&content), Some(Ok(())));
}

#[test]
fn forged_episode_length_and_return_stay_in_range() {
    let spec = registry().spec("Endless-SearingSpotlights-v0").unwrap();
    let mut game = Game::new(spec, Seeding::Continue { seed: Some(3) }, Map::new());
    let content = game.content();
    for (name, value) in [
        ("episode_length", Value::from(-1)),
        ("episode_length", Value::from(i32::MIN)),
        ("episode_return", Value::from(f64::NAN)),
        ("episode_return", Value::from(f64::INFINITY)),
    ] {
        let mut forged = content.clone();
        *field(&mut forged, name) = value;
        assert!(matches!(game.restore(&forged), Some(Err(SnapshotError::State(_)))), "{name}");
    }
    // The length saturates at its maximum.
    let mut forged = content.clone();
    *field(&mut forged, "episode_length") = Value::from(i32::MAX - 1);
    assert_eq!(game.restore(&forged), Some(Ok(())));
    for _ in 0..3 {
        game.play(1);
        let mut content = game.content();
        assert_eq!(*field(&mut content, "episode_length"), Value::from(i32::MAX));
    }
}
