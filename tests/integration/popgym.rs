//! Compares POPGym's ids with the original: recorded episodes, and live with new seeds.

use std::fs::File;

use endless_gym::envs::ActionSpace;
use endless_gym::pool::{Autoreset, PoolConfig, ResetOptions, ResetRequest};
use endless_gym::popgym;
use flate2::read::GzDecoder;
use rand::RngExt;
use rand::rngs::SmallRng;
use serde::Deserialize;
use serde_json::{Map, Value as Json, json};

use crate::support::player::Player;
use crate::support::process::Answering;
use crate::support::recorded::{check_at_once, reference};

/// One environment object of the original.
#[derive(Deserialize)]
struct Trace {
    env: String,
    options: Map<String, Json>,
    episodes: Vec<Episode>,
}

#[derive(Deserialize)]
struct Episode {
    /// `None` continues the generator of the last episode.
    seed: Option<u64>,
    observation: Vec<f64>,
    info: Map<String, Json>,
    steps: Vec<Step>,
}

/// Action, observation, reward, terminated, truncated, info.
#[derive(Deserialize)]
struct Step(Vec<f64>, Vec<f64>, f64, u8, u8, Map<String, Json>);

/// Plays a trace and compares every number. Returns the number of steps.
fn replay(trace: &Trace) -> usize {
    let config = PoolConfig::new(&trace.env, 1)
        .options(ResetOptions::Shared(trace.options.clone()))
        .autoreset(Autoreset::Disabled)
        .frames(None)
        .features(true);
    let mut player = Player::in_registry(popgym(), &config, 1);
    let is_box = matches!(player.pool.spec().action_space, ActionSpace::Box { .. });
    for (number, episode) in trace.episodes.iter().enumerate() {
        let place = format!("{}, episode {number}, seed {:?}", trace.env, episode.seed);
        player.reset(episode.seed.map_or(ResetRequest::All, ResetRequest::Seed));
        compare(&player, &episode.observation, &episode.info, &place);
        for (number, Step(action, observation, reward, terminated, truncated, info)) in episode.steps.iter().enumerate()
        {
            let place = format!("{place}, step {number}");
            let bits = |number: &f64| if is_box { (*number as f32).to_bits().cast_signed() } else { *number as i32 };
            player.step(&action.iter().map(bits).collect::<Vec<_>>());
            compare(&player, observation, info, &place);
            let batch = player.batch();
            assert_eq!(batch.reward()[0].to_bits(), reward.to_bits(), "reward: {place}");
            let flags = (batch.terminated()[0], batch.truncated()[0]);
            assert_eq!(flags, (*terminated, *truncated), "terminated and truncated: {place}");
        }
    }
    trace.episodes.iter().map(|episode| episode.steps.len()).sum()
}

fn compare(player: &Player, observation: &[f64], info: &Map<String, Json>, place: &str) {
    let batch = player.batch();
    let bits = |number: &f64| (*number as f32).to_bits();
    let found: Vec<_> = batch.features().iter().map(|number| number.to_bits()).collect();
    let expected: Vec<_> = observation.iter().map(bits).collect();
    assert_eq!(found, expected, "observation {:?}, expected {observation:?}: {place}", batch.features());
    for (name, expected) in info {
        let found = batch.ground_truth();
        let found = match name.as_str() {
            // The original names the first card's suit and rank.
            "card" => {
                let rank = batch.features()[0] as usize;
                json!([SUITS[found[0] as usize], RANKS[rank]])
            }
            "bandits" | "counts" | "position" => {
                json!(
                    found
                        .iter()
                        .zip(expected.as_array().unwrap())
                        .map(|(found, like)| { if like.is_i64() { json!(*found as i64) } else { json!(found) } })
                        .collect::<Vec<_>>()
                )
            }
            "maze" => continue,
            _ => panic!("an info that is not compared: `{name}`"),
        };
        assert_eq!(&found, expected, "info `{name}`: {place}");
    }
}

const SUITS: [&str; 4] = ["s", "d", "c", "h"];
const RANKS: [&str; 13] = ["a", "2", "3", "4", "5", "6", "7", "8", "9", "10", "j", "q", "k"];

fn replay_recorded(family: &str) {
    let file = reference().join(format!("popgym/{family}.json.gz"));
    let traces: Vec<Trace> = serde_json::from_reader(GzDecoder::new(File::open(file).unwrap())).unwrap();
    let ids: Vec<_> = traces.iter().map(|trace| trace.env.as_str()).collect();
    for level in ["Easy", "Medium", "Hard"] {
        assert!(ids.contains(&format!("popgym-{family}{level}-v0").as_str()), "{family} {level} in {ids:?}");
    }
    assert!(traces.iter().map(replay).sum::<usize>() > 100);
}

/// Ids with arguments, several for each argument of each class of the original.
fn with_arguments() -> Vec<String> {
    serde_json::from_reader(File::open(reference().join("popgym/arguments.json")).unwrap()).unwrap()
}

/// Steps of each id that are compared with the live original; a fifth of that with arguments.
const LIVE_STEPS: usize = 5_000;

/// Compares a family with the original, popgym[navigation]==1.0.7, in a separate process.
fn compare_live(family: &str) {
    let mut original = Answering::start("ENDLESS_POPGYM_PYTHON", &reference().join("popgym/record.py"), &["-"]);
    let given = std::env::var("ENDLESS_LIVE_STEPS").ok().map(|steps| steps.parse::<usize>().unwrap());
    let mut random: SmallRng = match given {
        Some(_) => rand::make_rng(),
        None => rand::SeedableRng::seed_from_u64(1),
    };
    let is_of_family = |id: &String| id.starts_with(&format!("popgym-{family}"));
    let levels = popgym().specs().map(|spec| spec.id.to_owned());
    for id in levels.chain(with_arguments()).filter(is_of_family) {
        let parameters = popgym().spec(&id).unwrap().parameters;
        let (mut steps, share) = (0, if id.contains('?') { 5 } else { 1 });
        while steps < given.unwrap_or(LIVE_STEPS) / share {
            let mut options = Map::new();
            for parameter in parameters {
                if let endless_gym::envs::ParameterKind::Float { min, max, .. } = parameter.kind
                    && random.random()
                {
                    options.insert(parameter.name.to_owned(), random.random_range(min..=max).into());
                }
            }
            let episodes = random.random_range(1..6);
            let request = json!({"env": id, "seed": random.random::<u64>(), "episodes": episodes, "options": options});
            steps += replay(&original.ask(&request));
        }
        println!("{id}: {steps} steps without a difference");
    }
}

/// Checks each family, whose ids are `popgym-FAMILYEasy-v0`, `popgym-FAMILYMedium-v0` and `popgym-FAMILYHard-v0`.
fn check_families(check: impl Fn(&str) + Sync) {
    let easy = |id: &'static str| id.strip_prefix("popgym-")?.strip_suffix("Easy-v0");
    let families: Vec<&str> = popgym().specs().filter_map(|spec| easy(spec.id)).collect();
    assert_eq!(3 * families.len(), popgym().specs().count());
    check_at_once(families.into_iter(), check);
}

#[test]
fn recorded_episodes_replay_without_a_difference() {
    check_families(replay_recorded);
}

mod live {
    #[test]
    #[ignore = "needs the original, in the Python that ENDLESS_POPGYM_PYTHON names: run `cargo xtask test --all`"]
    fn every_id_plays_as_the_original() {
        super::check_families(super::compare_live);
    }
}
