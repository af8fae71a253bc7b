//! Checks of an environment: whether it behaves as pools, engines and trainers rely on.
//!
//! ```
//! use endless_gym_core::conformance;
//! use endless_gym_memory_gym::memory_gym;
//!
//! let outcomes = conformance::check(memory_gym(), "MysteryPath-Grid-v0")?;
//! assert!(outcomes.iter().all(|outcome| outcome.problem.is_none()));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#[allow(unsafe_code)] // An allocator's methods are unsafe: see its SAFETY comment.
mod counting;

use std::panic::{AssertUnwindSafe, catch_unwind};

use serde_json::{Map, Value as Json, json};

use crate::batch::{Batch, Block, Frames, zeroed};
use crate::envs::{ActionSpace, EnvSpec, InfoColumn, Parameter, ParameterKind, StatePart, Task, UnknownEnvironment};
use crate::pool::{
    Autoreset, HEAD, OptionMap, Pool, PoolConfig, Registry, ResetOptions, ResetRequest, Seeding, Threads, message,
};
use crate::random::Generator;
use crate::raster::PixelFormat;

pub use counting::{CountingAllocator, allocations};

/// Environments of a pool.
const NUM_ENVS: usize = 4;

/// Steps of a check.
const STEPS: usize = 400;

/// A check and its outcome.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// What must be true.
    pub rule: &'static str,
    /// How the environment breaks it; `None` if it does not.
    pub problem: Option<String>,
}

type Rule = fn(&Registry, &EnvSpec) -> Result<(), String>;

const RULES: &[(&str, Rule)] = &[
    ("the same seed and actions give the same bytes in every environment and for every number of threads", repeats),
    ("another seed gives another episode", seeds_differ),
    ("an episode does not depend on those before it", forgets),
    ("an environment does not depend on its neighbours", is_alone),
    ("a snapshot continues identically", snapshots_continue),
    ("a changed frame equals one that is drawn in full", repaints),
    ("rewards and observations are finite and within the declared spaces", numbers_are_declared),
    ("a forged snapshot is refused, or continues within the declared spaces", forgeries_are_refused),
    ("every choice of every action can be played", actions_are_playable),
    ("every reset parameter can be played at its limits", limits_are_playable),
];

/// For programs with the [`CountingAllocator`].
const ALLOCATIONS: (&str, Rule) = ("a step does not allocate", steps_allocate_nothing);

/// Checks one id of a registry with random actions. A panic of the environment counts as a problem.
///
/// # Errors
///
/// [`UnknownEnvironment`] if the registry does not have the id.
pub fn check(registry: &Registry, id: &str) -> Result<Vec<Outcome>, UnknownEnvironment> {
    let spec = registry.spec(id)?;
    let outcome = |(rule, test): &(&'static str, Rule)| {
        let result = catch_unwind(AssertUnwindSafe(|| test(registry, spec)));
        let problem = result.unwrap_or_else(|panic| Err(format!("it panicked: {}", message(&*panic)))).err();
        Outcome { rule, problem }
    };
    Ok(RULES.iter().chain(counting::is_counting().then_some(&ALLOCATIONS)).map(outcome).collect())
}

/// Checks all ids of a task, for a test in its crate.
///
/// # Panics
///
/// If an id breaks a rule, or if a specification contradicts itself.
pub fn assert_conforms<T: Task>() {
    let registry = Registry::new().with::<T>().unwrap_or_else(|error| panic!("{error}"));
    for spec in registry.specs() {
        let outcomes = check(&registry, spec.id).unwrap_or_default();
        let problems =
            outcomes.into_iter().filter_map(|Outcome { rule, problem }| Some(format!("{rule}: {}", problem?)));
        let problems: Vec<_> = problems.collect();
        assert!(problems.is_empty(), "{} breaks rules:\n{}", spec.id, problems.join("\n"));
    }
}

/// A pool with the memory for its batch and random actions.
struct Game {
    pool: Pool,
    blocks: Vec<Block>,
    random: Generator,
}

impl Game {
    fn new(registry: &Registry, config: &PoolConfig, threads: usize) -> Result<Self, String> {
        let threads = Threads::new(threads).map_err(text)?;
        let pool = Pool::new(registry, config, &threads).map_err(text)?;
        let blocks = zeroed(pool.layout().blocks());
        Ok(Game { pool, blocks, random: Generator::from_seed(1) })
    }

    /// A game whose environments start with `seed`, `seed + 1` and so on.
    fn started(registry: &Registry, config: &PoolConfig, seed: u64) -> Result<Self, String> {
        let mut game = Game::new(registry, config, 1)?;
        game.reset(seed)?;
        Ok(game)
    }

    fn reset(&mut self, seed: u64) -> Result<(), String> {
        self.pool.reset(ResetRequest::Seed(seed), &mut self.blocks).map_err(text)
    }

    fn batch(&self) -> Batch<'_> {
        Batch::new(self.pool.layout(), &self.blocks)
    }

    /// Random actions for `num_envs` environments.
    fn actions(&mut self, num_envs: usize) -> Vec<i32> {
        let (space, random) = (&self.pool.spec().action_space, &mut self.random);
        (0..num_envs).flat_map(|_| space.sample(random)).collect()
    }

    fn step(&mut self, actions: &[i32]) -> Result<(), String> {
        self.pool.step(actions, &mut self.blocks).map_err(text)
    }

    /// Plays random actions and returns all batches.
    fn play(&mut self, steps: usize) -> Result<Vec<Vec<u8>>, String> {
        let mut played = vec![self.batch().bytes().to_vec()];
        for _ in 0..steps {
            let actions = self.actions(self.pool.layout().num_envs());
            self.step(&actions)?;
            played.push(self.batch().bytes().to_vec());
        }
        Ok(played)
    }

    /// Restores every environment's own snapshot.
    fn reload(&mut self) -> Result<(), String> {
        for env in 0..self.pool.layout().num_envs() {
            let snapshot = self.pool.snapshot(env).map_err(text)?;
            self.pool.restore(env, &snapshot).map_err(text)?;
            if self.pool.snapshot(env).map_err(text)? != snapshot {
                return Err("a snapshot restores another state".to_owned());
            }
        }
        Ok(())
    }

    /// Plays what was restored.
    fn continue_forged(&mut self) -> Result<(), String> {
        self.reload()?;
        self.pool.observe(&mut self.blocks).map_err(text)?;
        for step in 0..40 {
            check_numbers(self.pool.spec(), &self.batch()).map_err(|problem| format!("{problem} after step {step}"))?;
            self.play(1)?;
        }
        Ok(())
    }

    /// One environment's part of the batch.
    fn row(&self, env: usize) -> Vec<u8> {
        let bytes = self.batch().bytes();
        let sections = self.pool.layout().sections().iter();
        let rows = sections.flat_map(|section| {
            let length = section.bytes() / self.pool.layout().num_envs();
            &bytes[section.offset() + env * length..][..length]
        });
        rows.copied().collect()
    }
}

/// Updates the checksum of a snapshot, or of an engine's checkpoint, whose bytes were changed.
pub fn seal(snapshot: &mut [u8]) {
    if let Some((head, content)) = snapshot.split_at_mut_checked(HEAD) {
        head[8..].copy_from_slice(&crc32fast::hash(content).to_le_bytes());
    }
}

fn text(error: impl std::error::Error) -> String {
    error.to_string()
}

/// All that an environment can write, with fixed seeds.
fn config(spec: &EnvSpec, num_envs: usize) -> PoolConfig {
    let seeding = Seeding::Continue { seed: Some(0) };
    PoolConfig::new(spec.id, num_envs).features(!spec.features.is_empty()).state(true).seeding(seeding)
}

/// Fails at the first step after which two games differ.
fn compare(one: &[Vec<u8>], other: &[Vec<u8>], what: &str) -> Result<(), String> {
    match one.iter().zip(other).position(|(one, other)| one != other) {
        None => Ok(()),
        Some(0) => Err(format!("the first observation differs {what}")),
        Some(step) => Err(format!("step {step} differs {what}")),
    }
}

fn repeats(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    let play = |threads| {
        let mut game = Game::new(registry, &config(spec, 16 * NUM_ENVS), threads)?;
        game.reset(3)?;
        game.play(STEPS / 4)
    };
    let first = play(1)?;
    compare(&first, &play(1)?, "in another pool")?;
    compare(&first, &play(3)?, "with three threads")
}

fn seeds_differ(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    let play = |seed| Game::started(registry, &config(spec, 1), seed)?.play(STEPS);
    let first = play(0)?;
    for seed in 1..8 {
        if play(seed)? != first {
            return Ok(());
        }
    }
    Err(format!("the first {STEPS} steps are the same for 8 seeds"))
}

fn forgets(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    if spec.keeps_state {
        return Ok(());
    }
    let expected = Game::started(registry, &config(spec, NUM_ENVS), 5)?.play(STEPS / 4)?;
    let mut used = Game::started(registry, &config(spec, NUM_ENVS), 9)?;
    used.play(STEPS)?;
    used.reset(5)?;
    used.random = Generator::from_seed(1);
    compare(&expected, &used.play(STEPS / 4)?, "after other episodes; a family that keeps state must declare it")
}

fn is_alone(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    let mut together = Game::started(registry, &config(spec, NUM_ENVS), 7)?;
    let alone = (0..NUM_ENVS as u64).map(|env| Game::started(registry, &config(spec, 1), 7 + env));
    let mut alone = alone.collect::<Result<Vec<_>, _>>()?;
    let width = spec.action_space.width();
    for step in 0..STEPS / 4 {
        let actions = together.actions(NUM_ENVS);
        together.step(&actions)?;
        for (env, (game, action)) in alone.iter_mut().zip(actions.chunks_exact(width)).enumerate() {
            game.step(action)?;
            if game.row(0) != together.row(env) {
                return Err(format!("environment {env} differs from one without neighbours after step {}", step + 1));
            }
        }
    }
    Ok(())
}

fn snapshots_continue(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    use Autoreset::{Disabled, NextStep};
    for (start, autoreset) in [(0, NextStep), (1, NextStep), (7, NextStep), (40, NextStep), (STEPS, Disabled)] {
        let config = config(spec, 1).autoreset(autoreset);
        let mut game = Game::started(registry, &config, 11 + start as u64)?;
        let mut other = Game::started(registry, &config, 500)?;
        game.play(start)?;
        other.play(3)?;
        other.pool.restore(0, &game.pool.snapshot(0).map_err(text)?).map_err(text)?;
        for game in [&mut game, &mut other] {
            game.pool.observe(&mut game.blocks).map_err(text)?;
            game.random = Generator::from_seed(2);
        }
        let what = format!("after a restored snapshot of step {start}");
        compare(&game.play(STEPS / 4)?, &other.play(STEPS / 4)?, &what)?;
    }
    Ok(())
}

fn repaints(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    let Some(frame) = spec.frame else { return pictures(registry, spec) };
    for (bits, stack) in [(0, 1), (1, 1), (2, 3), (4, 2)] {
        let format = PixelFormat {
            grayscale: bits == 4 && frame.channels == 3,
            channels_first: bits == 1,
            row_major: bits == 2,
        };
        let frames = Some(Frames { format, stack });
        let config = config(spec, NUM_ENVS).frames(frames).check_drawing(true);
        Game::started(registry, &config, 13)?.play(STEPS)?;
    }
    Ok(())
}

/// Draws the pictures of an environment without frames.
fn pictures(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    if spec.picture.is_none() {
        return Ok(());
    }
    let mut game = Game::started(registry, &config(spec, NUM_ENVS), 13)?;
    for _ in 0..STEPS {
        game.pool.frame(0).map_err(text)?;
        let actions = game.actions(NUM_ENVS);
        game.step(&actions)?;
    }
    Ok(())
}

fn numbers_are_declared(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    let mut game = Game::started(registry, &config(spec, NUM_ENVS), 17)?;
    for step in 0..=STEPS {
        check_numbers(spec, &game.batch()).map_err(|problem| format!("{problem} after step {step}"))?;
        let actions = game.actions(NUM_ENVS);
        game.step(&actions)?;
    }
    Ok(())
}

/// Checks that the rewards and observations of a batch are finite and within the spaces that the specification declares.
///
/// # Errors
///
/// The first number that is not, as text.
pub fn check_numbers<'a>(spec: &EnvSpec, batch: &Batch<'a>) -> Result<(), String> {
    if let Some(reward) = batch.reward().iter().find(|reward| !reward.is_finite()) {
        return Err(format!("the reward is {reward}"));
    }
    let rows = |section: &'a [f32]| section.chunks_exact(spec.features.len().max(1)).enumerate();
    let ended = rows(batch.final_features()).filter(|(env, _)| batch.has_ended(*env));
    for (_, row) in rows(batch.features()).chain(ended) {
        if let Some(number) = row.iter().position(|number| !number.is_finite()) {
            return Err(format!("the feature `{}` is {}", spec.features[number].name, row[number]));
        }
        if let Some(space) = spec.observation_space.filter(|space| !space.contains(row)) {
            return Err(format!("the features {row:?} are not in {space}"));
        }
    }
    let (least, largest) = spec.ground_truth_bounds.unwrap_or((f32::MIN, f32::MAX));
    let bounds = f64::from(least)..=f64::from(largest);
    if let Some(number) = batch.ground_truth().iter().find(|number| !bounds.contains(number)) {
        return Err(format!("a number of the ground truth is {number}"));
    }
    let width = spec.markov_state.iter().map(StatePart::width).sum::<usize>().max(1);
    let rows = |section: &'a [f32]| section.chunks_exact(width).enumerate();
    let ended = rows(batch.final_state()).filter(|(env, _)| batch.has_ended(*env));
    for (_, mut row) in rows(batch.state()).chain(ended) {
        for part in spec.markov_state {
            let (numbers, rest) = row.split_at(part.width());
            if !part.contains(numbers) {
                return Err(format!("the state `{}`, {numbers:?}, is not in its space", part.name));
            }
            row = rest;
        }
    }
    for (env, row) in batch.info().chunks_exact(spec.info.len().max(1)).enumerate() {
        let wrong =
            |(column, number): (&InfoColumn, &f64)| column.is_integer && batch.has_ended(env) && number.fract() != 0.0;
        if let Some(number) = spec.info.iter().zip(row).position(wrong) {
            return Err(format!(
                "the info `{}` is declared an integer, and is {}",
                spec.info[number].name, row[number]
            ));
        }
    }
    Ok(())
}

fn forgeries_are_refused(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    let mut game = Game::started(registry, &config(spec, 1), 31)?;
    game.play(7)?;
    let (snapshot, mut random) = (game.pool.snapshot(0).map_err(text)?, Generator::from_seed(1));
    for number in 0..2 * STEPS {
        let mut forged = snapshot.clone();
        let start = HEAD + number * (snapshot.len() - HEAD) / (2 * STEPS);
        let float = *random.choice(&[f64::NAN, f64::INFINITY, -1e200, 1e9, f64::from_bits(1 << 63 | 1)]);
        let bytes = match random.integers(0, 3) {
            0 => float.to_le_bytes().to_vec(),
            1 => (float as f32).to_le_bytes().to_vec(),
            _ => vec![random.integers(0, 256) as u8],
        };
        forged.iter_mut().skip(start).zip(&bytes).for_each(|(to, byte)| *to = *byte);
        seal(&mut forged);
        if game.pool.restore(0, &forged).is_ok() {
            let continued = catch_unwind(AssertUnwindSafe(|| game.continue_forged()));
            let continued = continued.unwrap_or_else(|panic| Err(format!("it panicked: {}", message(&*panic))));
            continued.map_err(|problem| {
                format!("`is_valid` accepts a snapshot with the bytes {bytes:?} from {start} on, but {problem}")
            })?;
        }
    }
    Ok(())
}

fn actions_are_playable(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    let mut game = Game::started(registry, &config(spec, 1), 19)?;
    let most = spec.action_space.branches().iter().copied().max().unwrap_or(0);
    for repeated in 0..most {
        let action: Vec<i32> = spec.action_space.branches().iter().map(|choices| repeated.min(choices - 1)).collect();
        for _ in 0..STEPS / 4 {
            game.step(&action)?;
        }
    }
    if let ActionSpace::Box { low, high } = &spec.action_space {
        for bounds in [low, high] {
            let action: Vec<i32> = bounds.iter().map(|bound| bound.to_bits().cast_signed()).collect();
            for _ in 0..STEPS / 4 {
                game.step(&action)?;
            }
        }
    }
    Ok(())
}

fn limits_are_playable(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    for parameter in spec.parameters {
        for value in limits(parameter) {
            let options: OptionMap = Map::from_iter([(parameter.name.to_owned(), value.clone())]);
            let config = config(spec, NUM_ENVS).options(ResetOptions::Shared(options)).autoreset(Autoreset::SameStep);
            let play = || {
                let mut game = Game::started(registry, &config, 23)?;
                (0..STEPS / 8).try_for_each(|_| game.play(1).and_then(|_| game.reload()))
            };
            let played = catch_unwind(AssertUnwindSafe(play)).unwrap_or_else(|panic| Err(message(&*panic)));
            played.map_err(|error| format!("`{}` = {value}: {error}", parameter.name))?;
        }
    }
    Ok(())
}

fn steps_allocate_nothing(registry: &Registry, spec: &EnvSpec) -> Result<(), String> {
    let mut game = Game::started(registry, &config(spec, NUM_ENVS), 29)?;
    let mut allocations = 0;
    // Lists grow until they have reached their largest length.
    for _ in 0..10 {
        allocations = 0;
        for _ in 0..STEPS {
            let actions = game.actions(NUM_ENVS);
            let before = counting::allocations();
            game.step(&actions)?;
            allocations += counting::allocations() - before;
        }
        if allocations == 0 {
            return Ok(());
        }
    }
    Err(format!("{allocations} allocations in {STEPS} steps of {NUM_ENVS} environments; reuse the memory of lists"))
}

fn limits(parameter: &Parameter) -> Vec<Json> {
    match parameter.kind {
        ParameterKind::Bool { .. } => vec![json!(false), json!(true)],
        ParameterKind::Int { min, max, .. } => vec![json!(min), json!(max)],
        ParameterKind::Float { min, max, .. } => vec![json!(min), json!(max)],
        ParameterKind::IntList { min, max, .. } => vec![json!([min]), json!([max]), json!([min, max])],
        ParameterKind::Choice { choices, .. } => choices.iter().map(|choice| json!(choice)).collect(),
    }
}
