//! Forged snapshots: every number of a snapshot is set to extreme values, with a valid checksum. Each snapshot is
//! refused or can be played; none panics, and none hangs.

mod common;

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use ciborium::Value;
use endless_gym::batch::{Block, zeroed};
use endless_gym::envs::view::VIEW_BYTES;
use endless_gym::pool::{Autoreset, Pool, PoolConfig, ResetOptions, ResetRequest, Seeding, SnapshotError, Threads};
use endless_gym_core::envs::{self, EnvSpec, Family, ParameterKind, mortar_mayhem, mystery_path, searing_spotlights};
use proptest::prelude::*;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value as Json};

/// Magic, version and checksum.
const HEAD: usize = 12;

/// The content of a snapshot, field for field as the pool encodes it.
#[derive(Serialize, Deserialize)]
struct Content<S> {
    id: String,
    options: String,
    random: Pcg,
    seeds: Seeds,
    episode_return: f64,
    episode_length: i32,
    ended: bool,
    state: S,
}

#[derive(Serialize, Deserialize)]
struct Pcg {
    state: u128,
    increment: u128,
    kept: Option<u32>,
}

#[derive(Serialize, Deserialize)]
enum Seeds {
    Continue { first: Option<u64> },
    Range { draws: Pcg },
    List { next: usize },
}

/// Converts the content of one family's snapshots from and to a tree of values.
#[derive(Clone, Copy)]
struct Codec {
    decode: fn(&[u8]) -> Value,
    /// `None` if a value does not fit its type.
    encode: fn(&Value) -> Option<Vec<u8>>,
}

impl Codec {
    fn of<S: Serialize + DeserializeOwned>() -> Self {
        Codec {
            decode: |snapshot| {
                Value::serialized(&postcard::from_bytes::<Content<S>>(&snapshot[HEAD..]).unwrap()).unwrap()
            },
            encode: |value| Some(postcard::to_stdvec(&value.deserialized::<Content<S>>().ok()?).unwrap()),
        }
    }

    fn for_spec(spec: &EnvSpec) -> Self {
        match spec.family {
            Family::MortarMayhem(_) => Codec::of::<mortar_mayhem::State>(),
            Family::MysteryPath(_) => Codec::of::<mystery_path::State>(),
            Family::SearingSpotlights(_) => Codec::of::<searing_spotlights::State>(),
        }
    }
}

/// A pool of one environment, and snapshots of it.
struct Game {
    spec: &'static EnvSpec,
    pool: Pool,
    blocks: Vec<Block>,
    random: SmallRng,
    codec: Codec,
    head: [u8; HEAD],
    watchdog: Watchdog,
}

impl Game {
    fn new(spec: &'static EnvSpec, seeding: Seeding, options: Map<String, Json>) -> Self {
        let config = PoolConfig {
            seeding,
            options: ResetOptions::Shared(options),
            autoreset: Autoreset::SameStep,
            final_observation: true,
            features: true,
            ..PoolConfig::new(spec.id, 1)
        };
        let mut pool = Pool::new(&config, &Threads::new(1).unwrap()).unwrap();
        let mut blocks = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut blocks).unwrap();
        let random = SmallRng::seed_from_u64(1);
        Game { spec, pool, blocks, random, codec: Codec::for_spec(spec), head: [0; HEAD], watchdog: Watchdog::new() }
    }

    fn play(&mut self, steps: usize) {
        for _ in 0..steps {
            let branches = self.spec.action_space.branches();
            let action: Vec<i32> = branches.iter().map(|n| self.random.random_range(0..*n)).collect();
            self.pool.step(&action, &mut self.blocks).unwrap();
        }
    }

    fn content(&mut self) -> Value {
        let snapshot = self.pool.snapshot(0).unwrap();
        self.head.copy_from_slice(&snapshot[..HEAD]);
        let content = (self.codec.decode)(&snapshot);
        assert_eq!((self.codec.encode)(&content).unwrap(), &snapshot[HEAD..], "the encoding of {}", self.spec.id);
        content
    }

    /// Restores forged content; `None` if it cannot be encoded.
    fn restore(&mut self, content: &Value) -> Option<Result<(), SnapshotError>> {
        let content = (self.codec.encode)(content)?;
        let mut snapshot = self.head.to_vec();
        snapshot[8..].copy_from_slice(&crc32fast::hash(&content).to_le_bytes());
        snapshot.extend(content);
        Some(self.pool.restore(0, &snapshot))
    }

    /// Restores forged content and, if it is not refused, plays it: to the end of the episode or not, and in another
    /// episode.
    fn try_to_play(&mut self, content: &Value) -> Outcome {
        self.watchdog.set(Some(content));
        let outcome = self.outcome(content);
        self.watchdog.set(None);
        outcome
    }

    fn outcome(&mut self, content: &Value) -> Outcome {
        match self.restore(content) {
            None => Outcome::NotEncodable,
            Some(Err(_)) => Outcome::Refused,
            Some(Ok(())) => {
                self.pool.observe(&mut self.blocks).unwrap();
                self.pool.ground_truth_view(0, &mut [0; VIEW_BYTES]).unwrap();
                self.play(40);
                self.pool.ground_truth_view(0, &mut [0; VIEW_BYTES]).unwrap();
                self.pool.snapshot(0).unwrap();
                self.pool.reset(ResetRequest::All, &mut self.blocks).unwrap();
                self.play(2);
                Outcome::Played
            }
        }
    }
}

/// Ends the process, with the forged content, if a case takes longer than any snapshot may.
struct Watchdog {
    /// When the running case started, and its content.
    case: Arc<Mutex<Option<(Instant, Value)>>>,
}

impl Watchdog {
    fn new() -> Self {
        let case = Arc::new(Mutex::new(None::<(Instant, Value)>));
        let watched = Arc::downgrade(&case);
        std::thread::spawn(move || {
            while let Some(case) = watched.upgrade() {
                if let Some((start, content)) = &*case.lock().unwrap()
                    && start.elapsed() > Duration::from_secs(60)
                {
                    let content: String = format!("{content:?}").chars().take(5000).collect();
                    eprintln!("a forged snapshot hangs: {content}");
                    std::process::abort();
                }
                drop(case);
                std::thread::sleep(Duration::from_millis(200));
            }
        });
        Watchdog { case }
    }

    fn set(&self, content: Option<&Value>) {
        *self.case.lock().unwrap() = content.map(|content| (Instant::now(), content.clone()));
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Outcome {
    NotEncodable,
    Refused,
    Played,
}

/// Where a value is in the tree: the index at each level.
type Path = Vec<usize>;

fn children(value: &mut Value) -> Vec<&mut Value> {
    match value {
        Value::Array(items) => items.iter_mut().collect(),
        Value::Map(entries) => entries.iter_mut().map(|(_, value)| value).collect(),
        _ => Vec::new(),
    }
}

fn at<'a>(value: &'a mut Value, path: &[usize]) -> &'a mut Value {
    match path.split_first() {
        Some((index, rest)) => at(children(value).swap_remove(*index), rest),
        None => value,
    }
}

/// The paths of all numbers and lists. Of a long list only the first and the last items are walked.
fn paths(value: &mut Value) -> Vec<Path> {
    let mut found = match value {
        Value::Integer(_) | Value::Float(_) | Value::Bool(_) | Value::Null | Value::Array(_) | Value::Tag(..) => {
            vec![Vec::new()]
        }
        _ => Vec::new(),
    };
    let is_list = value.is_array();
    let children = children(value);
    let count = children.len();
    for (index, child) in children.into_iter().enumerate() {
        if !is_list || index < 3 || index + 2 > count {
            found.extend(paths(child).into_iter().map(|rest| [vec![index], rest].concat()));
        }
    }
    found
}

/// Values to put in the place of any number or list.
fn extremes() -> Vec<Value> {
    // About zero, at the limits of the types, and at limits of coordinates and counters.
    let bounds = [1 << 8, 1 << 13, 1 << 15, 1 << 28, 1 << 31, 1 << 32, 1 << 62, 1 << 63, 1 << 64_i128];
    let integers = bounds.into_iter().flat_map(|bound| [bound - 4, bound - 1, bound, -bound]).chain([-1, 0, 1, 2]);
    let in_range = |value: &i128| (i128::from(i64::MIN)..=i128::from(u64::MAX)).contains(value);
    let floats = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX, f64::MIN, -0.0, f64::MIN_POSITIVE, -1e9, 1e9];
    let others = [Value::Bool(false), Value::Bool(true), Value::Null, Value::Array(Vec::new())];
    let integers = integers.filter(in_range).map(|value| Value::Integer(value.try_into().unwrap()));
    integers.chain(floats.into_iter().map(Value::Float)).chain(others).collect()
}

/// Number of items of a forged list: more than any list has by play within a test.
const MANY: usize = 100_000;

#[test]
fn every_list_can_be_long() {
    for spec in envs::specs() {
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
        if matches!(spec.family, Family::SearingSpotlights(_)) {
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

/// Each of the policies, whose place in the sequence of seeds a snapshot holds.
fn seedings() -> [Seeding; 3] {
    [
        Seeding::Continue { seed: Some(3) },
        Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(3) },
        Seeding::List(vec![5, 6, 7]),
    ]
}

/// Reset parameters with every flag set.
fn all_flags(spec: &EnvSpec) -> Map<String, Json> {
    let flags = spec.parameters.iter().filter(|parameter| matches!(parameter.kind, ParameterKind::Bool { .. }));
    flags.map(|parameter| (parameter.name.to_owned(), Json::from(true))).collect()
}

#[test]
fn every_number_can_be_extreme() {
    for (spec, seeding) in envs::specs().zip(seedings().into_iter().cycle()) {
        let (mut refused, mut played) = (0, 0);
        // The second time with everything that a flag can turn on.
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
        assert!(refused > 100 && played > 100, "{}: {refused} refused, {played} played", spec.id);
    }
}

fn field<'a>(value: &'a mut Value, name: &str) -> &'a mut Value {
    let Value::Map(entries) = value else { panic!("no fields in {value:?}") };
    entries.iter_mut().find(|(key, _)| key.as_text() == Some(name)).map(|(_, value)| value).unwrap()
}

#[test]
fn an_even_increment_is_refused() {
    // PCG64 with state 0 and increment 0 returns only zeros, which rejection sampling redraws forever.
    let spec = envs::spec("MysteryPath-v0").unwrap();
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
fn sums_of_the_episode_stay_in_range() {
    let spec = envs::spec("Endless-SearingSpotlights-v0").unwrap();
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
    // The largest length is not exceeded.
    let mut forged = content.clone();
    *field(&mut forged, "episode_length") = Value::from(i32::MAX - 1);
    assert_eq!(game.restore(&forged), Some(Ok(())));
    for _ in 0..3 {
        game.play(1);
        let mut content = game.content();
        assert_eq!(*field(&mut content, "episode_length"), Value::from(i32::MAX));
    }
}

proptest! {
    #![proptest_config(common::property_cases(300))]

    /// Several numbers at a time.
    #[test]
    fn numbers_can_be_extreme_together(
        number in 0..10_usize,
        steps in 0..60_usize,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<prop::sample::Index>()), 2..5),
    ) {
        let mut game = Game::new(envs::specs().nth(number).unwrap(), Seeding::Continue { seed: Some(3) }, Map::new());
        game.play(steps);
        let (mut content, extremes) = (game.content(), extremes());
        for (path, extreme) in changes {
            let mut forged = content.clone();
            let paths = paths(&mut forged);
            let path: &Path = path.get(&paths);
            *at(&mut forged, path) = extreme.get(&extremes).clone();
            // Keeps what can be played, and forges further numbers of it.
            if game.try_to_play(&forged) == Outcome::Played {
                content = forged;
            }
        }
    }
}
