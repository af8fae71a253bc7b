//! Snapshots with a valid checksum, in which numbers may have any value.

use arbitrary::Unstructured;
use ciborium::Value;
use endless_gym::environments;
use endless_gym_core::batch::{Batch, Block, zeroed};
use endless_gym_core::conformance::{check_numbers, seal};
use endless_gym_core::envs::EnvSpec;
use endless_gym_core::pool::{Autoreset, Pool, ResetRequest, Seeding, SnapshotError, Threads};
use endless_gym_core::random::Generator;
use endless_gym_memory_gym::{mortar_mayhem, mystery_path, searing_spotlights};
use endless_gym_popgym::{
    autoencode, battleship, cart_pole, concentration, count_recall, higher_lower, labyrinth, mine_sweeper,
    multiarmed_bandit, pendulum, repeat_first, repeat_previous,
};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value as Json};

use crate::playing;
use crate::watchdog::within_budget;

/// Magic, version and checksum.
const HEAD: usize = 12;

/// Maximum number of changes per input.
const MAX_CHANGES: usize = 12;

/// The content of a snapshot, with the fields in the pool's encoding.
#[derive(Serialize, Deserialize)]
struct Content<S> {
    id: String,
    options: String,
    next_options: Option<String>,
    episode_seed: Option<u64>,
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
        match spec.id {
            id if id.contains("MortarMayhem") => Codec::of::<mortar_mayhem::State>(),
            id if id.contains("MysteryPath") => Codec::of::<mystery_path::State>(),
            id if id.contains("SearingSpotlights") => Codec::of::<searing_spotlights::State>(),
            id if id.contains("Autoencode") => Codec::of::<autoencode::Autoencode>(),
            id if id.contains("Battleship") => Codec::of::<battleship::Battleship>(),
            id if id.to_lowercase().contains("cartpole") => Codec::of::<cart_pole::CartPole>(),
            id if id.contains("Concentration") => Codec::of::<concentration::Concentration>(),
            id if id.contains("CountRecall") => Codec::of::<count_recall::CountRecall>(),
            id if id.contains("HigherLower") => Codec::of::<higher_lower::HigherLower>(),
            id if id.contains("Labyrinth") => Codec::of::<labyrinth::Labyrinth>(),
            id if id.contains("MineSweeper") => Codec::of::<mine_sweeper::MineSweeper>(),
            id if id.contains("MultiarmedBandit") => Codec::of::<multiarmed_bandit::MultiarmedBandit>(),
            id if id.contains("Pendulum") => Codec::of::<pendulum::Pendulum>(),
            id if id.contains("RepeatFirst") => Codec::of::<repeat_first::RepeatFirst>(),
            id if id.contains("RepeatPrevious") => Codec::of::<repeat_previous::RepeatPrevious>(),
            id => panic!("the state of {id} is not known"),
        }
    }
}

/// A pool of one environment, and snapshots of it.
pub struct Game {
    spec: &'static EnvSpec,
    pool: Pool,
    blocks: Vec<Block>,
    random: Generator,
    codec: Codec,
    head: [u8; HEAD],
}

impl Game {
    /// Creates an environment and resets it.
    pub fn new(spec: &'static EnvSpec, seeding: Seeding, options: Map<String, Json>) -> Self {
        let config = playing::config(spec, options, Autoreset::SameStep).seeding(seeding);
        let mut pool = Pool::new(environments(), &config, &Threads::new(1).unwrap()).unwrap();
        let mut blocks = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut blocks).unwrap();
        let random = Generator::from_seed(1);
        Game { spec, pool, blocks, random, codec: Codec::for_spec(spec), head: [0; HEAD] }
    }

    /// Plays random actions.
    pub fn play(&mut self, steps: usize) {
        for _ in 0..steps {
            let action = self.spec.action_space.sample(&mut self.random);
            self.pool.step(&action, &mut self.blocks).unwrap();
        }
    }

    /// The decoded content of a snapshot.
    pub fn content(&mut self) -> Value {
        let snapshot = self.snapshot();
        self.head.copy_from_slice(&snapshot[..HEAD]);
        let content = (self.codec.decode)(&snapshot);
        assert_eq!((self.codec.encode)(&content).unwrap(), &snapshot[HEAD..], "the encoding of {}", self.spec.id);
        content
    }

    /// Restores forged content; `None` if it cannot be encoded.
    pub fn restore(&mut self, content: &Value) -> Option<Result<(), SnapshotError>> {
        let content = (self.codec.encode)(content)?;
        let mut snapshot = self.head.to_vec();
        snapshot[8..].copy_from_slice(&crc32fast::hash(&content).to_le_bytes());
        snapshot.extend(content);
        Some(self.pool.restore(0, &snapshot))
    }

    /// Restores forged content and plays it unless it is refused.
    pub fn try_to_play(&mut self, content: &Value) -> Outcome {
        within_budget(content.clone(), || match self.restore(content) {
            None => Outcome::NotEncodable,
            Some(restored) => self.outcome(restored.is_ok()),
        })
    }

    /// Restores a snapshot with changed bytes, and plays it unless it is refused.
    fn try_to_play_bytes(&mut self, mut forged: Vec<u8>) -> Outcome {
        seal(&mut forged);
        within_budget(forged.clone(), || {
            let restored = self.pool.restore(0, &forged);
            self.outcome(restored.is_ok())
        })
    }

    fn outcome(&mut self, is_restored: bool) -> Outcome {
        if !is_restored {
            return Outcome::Refused;
        }
        self.play_on();
        Outcome::Played
    }

    /// A snapshot.
    pub fn snapshot(&self) -> Vec<u8> {
        self.pool.snapshot(0).unwrap()
    }

    /// Plays a restored state, which must continue as one that the environment can be in, and then another episode.
    fn play_on(&mut self) {
        let snapshot = self.snapshot();
        self.pool.restore(0, &snapshot).unwrap();
        assert!(self.snapshot() == snapshot, "{}", self.spec.id);
        self.pool.observe(&mut self.blocks).unwrap();
        playing::view(&mut self.pool);
        self.check(true);
        for _ in 0..40 {
            self.play(1);
            self.check(false);
        }
        playing::view(&mut self.pool);
        self.pool.reset(ResetRequest::All, &mut self.blocks).unwrap();
        self.play(2);
    }

    fn check(&self, is_first: bool) {
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        let reward = batch.reward()[0];
        if self.spec.frame.is_none() {
            assert!(reward.abs() <= 1.0, "{}: a reward of {reward}", self.spec.id);
        } else if is_first || batch.has_ended(0) {
            // As in the original, an agent may start up to two pixels beyond the bounds of the ground truth.
            return;
        }
        check_numbers(self.spec, &batch).unwrap_or_else(|problem| panic!("{}: {problem}", self.spec.id));
    }
}

/// What became of forged content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// A value does not fit its type.
    NotEncodable,
    /// The pool refused it.
    Refused,
    /// It was played.
    Played,
}

/// Where a value is in the tree: the index at each level.
pub type Path = Vec<usize>;

fn children(value: &mut Value) -> Vec<&mut Value> {
    match value {
        Value::Array(items) => items.iter_mut().collect(),
        Value::Map(entries) => entries.iter_mut().map(|(_, value)| value).collect(),
        _ => Vec::new(),
    }
}

/// The value at `path`.
pub fn at<'a>(value: &'a mut Value, path: &[usize]) -> &'a mut Value {
    match path.split_first() {
        Some((index, rest)) => at(children(value).swap_remove(*index), rest),
        None => value,
    }
}

/// The paths of all numbers and lists. Only the first and the last items of a long list are visited.
pub fn paths(value: &mut Value) -> Vec<Path> {
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

/// Values to replace any number or list.
pub fn extremes() -> Vec<Value> {
    // Near zero, at the limits of types, and at the limits of coordinates and counters.
    let bounds = [1 << 8, 1 << 13, 1 << 15, 1 << 28, 1 << 31, 1 << 32, 1 << 62, 1 << 63, 1 << 64_i128];
    let integers = bounds.into_iter().flat_map(|bound| [bound - 4, bound - 1, bound, -bound]).chain([-1, 0, 1, 2]);
    let in_range = |value: &i128| (i128::from(i64::MIN)..=i128::from(u64::MAX)).contains(value);
    let floats =
        [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX, f64::MIN, -0.0, f64::MIN_POSITIVE, -1e9, 1e9, 1e200];
    let others = [Value::Bool(false), Value::Bool(true), Value::Null, Value::Array(Vec::new())];
    let integers = integers.filter(in_range).map(|value| Value::Integer(value.try_into().unwrap()));
    integers.chain(floats.into_iter().map(Value::Float)).chain(others).collect()
}

/// All kinds of seeding, since a snapshot holds the position in the sequence of seeds.
pub fn seedings() -> [Seeding; 3] {
    [
        Seeding::Continue { seed: Some(3) },
        Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(3) },
        Seeding::List(vec![5, 6, 7]),
    ]
}

/// The target: plays a snapshot in which some numbers, or some bytes, are replaced.
pub fn target(input: &mut Unstructured<'_>) -> arbitrary::Result<()> {
    let spec = playing::spec(input)?;
    let seeding = input.choose(&seedings())?.clone();
    let mut game = Game::new(spec, seeding, Map::new());
    game.play(input.int_in_range(0..=60)?);
    if input.arbitrary()? {
        let mut snapshot = game.snapshot();
        for _ in 0..input.int_in_range(1..=8)? {
            let place = input.choose_index(snapshot.len())?;
            snapshot[place] = input.arbitrary()?;
        }
        game.try_to_play_bytes(snapshot);
        return Ok(());
    }
    let (mut content, extremes) = (game.content(), extremes());
    for _ in 0..MAX_CHANGES {
        if input.is_empty() {
            break;
        }
        let mut forged = content.clone();
        let paths = paths(&mut forged);
        let path: &Path = input.choose(&paths)?;
        *at(&mut forged, path) = match input.arbitrary::<Option<i64>>()? {
            Some(number) => Value::from(number),
            None => input.choose(&extremes)?.clone(),
        };
        // Keep forging content that can be played.
        if game.try_to_play(&forged) == Outcome::Played {
            content = forged;
        }
    }
    Ok(())
}
