//! The seeds of episodes.

use std::sync::atomic::{AtomicU32, Ordering};

use serde::{Deserialize, Serialize};

use crate::random::{EntropyError, Generator, SeedSequence, entropy};

/// Maximum total number of environments in all pools: an environment's number is one 32-bit word of a spawn key.
pub(super) const MAX_TOTAL_ENVS: usize = u32::MAX as usize;

/// The source of the episodes' seeds. Environments are numbered across all groups of an engine, so results depend neither on
/// the number of threads nor on the division into groups.
///
/// In JSON: `{"continue": {"seed": 1}}`, `{"range": {"start": 0, "end": 100000, "step": 1, "seed": 1}}` or `{"list": [3, 4]}`, where
/// `seed` may be `null` or omitted, and `start` and `step` may be omitted.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Seeding {
    /// Environment `i` is seeded once with `seed + i`, and every later episode continues its generator, as in Gymnasium when it
    /// is reset without a seed.
    ///
    /// Under any policy, a reset with an explicit seed `s` restarts the environment's seeds: with `Continue` its later episodes
    /// continue the generator of `s`, with `Range` they draw with `SeedSequence(s, spawn_key=(0,))`, and with `List` they start
    /// again at the environment's first item.
    Continue {
        /// The seed of environment 0; `None` seeds each environment from the operating system's entropy.
        #[serde(default)]
        seed: Option<u64>,
    },
    /// Each episode draws its seed uniformly from `start`, `start + step`, ... below `end`. The paper trains on `0..100000`.
    Range {
        /// The lowest seed; 0 by default.
        #[serde(default)]
        start: u64,
        /// The end of the range, excluded: more than `start`, and at most 2^63 - 1.
        end: u64,
        /// The difference between two seeds, 1 or more; 1 by default.
        #[serde(default = "one")]
        step: u64,
        /// Seed of the draws: environment `i` draws with `SeedSequence(seed, spawn_key=(i,))`. `None` uses the operating
        /// system's entropy.
        #[serde(default)]
        seed: Option<u64>,
    },
    /// Episode `e` of environment `i` of `n` has the seed at index `(e * n + i) % length` of the list, which must not be empty.
    List(Vec<u64>),
}

impl Default for Seeding {
    /// Seeds from entropy.
    fn default() -> Self {
        Seeding::Continue { seed: None }
    }
}

fn one() -> u64 {
    1
}

impl Seeding {
    /// Whether every episode has a given seed, so that no entropy is needed.
    fn is_seeded(&self) -> bool {
        !matches!(self, Seeding::Continue { seed: None } | Seeding::Range { seed: None, .. })
    }
}

/// The entropy of a pool. One draw from the operating system serves all environments: each derives its stream by a spawn key,
/// as with numpy's `SeedSequence.spawn`.
#[derive(Clone, Copy, Debug)]
pub(super) struct PoolEntropy(SeedSequence);

impl PoolEntropy {
    /// Draws entropy. Fails only if there is no source of entropy and `seeding` needs one.
    pub(super) fn draw(seeding: &Seeding) -> Result<Self, EntropyError> {
        let bits = match entropy() {
            Err(error) if !seeding.is_seeded() => return Err(error),
            bits => bits.unwrap_or(0),
        };
        Ok(PoolEntropy(SeedSequence::from_u128(bits)))
    }

    /// The generator that environment number `env` starts with.
    pub(super) fn environment(self, env: usize) -> Generator {
        Generator::from_seed_sequence(&self.0.with_spawn_key(&[env as u32, 0]))
    }

    /// The generator that draws the seeds of environment number `env`.
    fn seeds(self, env: usize) -> Generator {
        Generator::from_seed_sequence(&self.0.with_spawn_key(&[env as u32, 1]))
    }

    /// A number that is unique among the pools of this process and, with entropy, across processes.
    pub(super) fn identity(self) -> u64 {
        static POOLS: AtomicU32 = AtomicU32::new(0);
        let number = POOLS.fetch_add(1, Ordering::Relaxed);
        let [identity] = self.0.with_spawn_key(&[number, 0, 0]).generate_state_u64();
        identity
    }
}

/// The seeds of one environment's episodes.
#[derive(Debug)]
pub(super) enum Seeds {
    Continue {
        first: Option<u64>,
    },
    Range {
        start: u64,
        step: u64,
        count: i64,
        draws: Generator,
    },
    /// The seeds of [`Continue`](Self::Continue) with [`PoolConfig::independent_episodes`](super::PoolConfig::independent_episodes).
    Independent {
        first: Option<u64>,
        draws: Generator,
    },
    /// Indices are less than the length of the list.
    List {
        seeds: std::sync::Arc<[u64]>,
        first: usize,
        next: usize,
        stride: usize,
    },
}

impl Seeds {
    /// The seeds of environment number `env` of `total`.
    pub(super) fn new(
        seeding: &Seeding,
        list: &std::sync::Arc<[u64]>,
        env: usize,
        total: usize,
        unseeded: PoolEntropy,
    ) -> Self {
        match seeding {
            Seeding::Continue { seed } => Seeds::Continue { first: seed.map(|seed| seed.wrapping_add(env as u64)) },
            Seeding::Range { start, end, step, seed } => Seeds::Range {
                start: *start,
                step: *step,
                count: (end - start).div_ceil(*step) as i64,
                draws: match seed {
                    Some(seed) => {
                        Generator::from_seed_sequence(&SeedSequence::new(*seed).with_spawn_key(&[env as u32]))
                    }
                    None => unseeded.seeds(env),
                },
            },
            Seeding::List(_) => {
                let first = env % list.len();
                Seeds::List { seeds: list.clone(), first, next: first, stride: total % list.len() }
            }
        }
    }

    /// The seeds of environment number `env` when no episode may continue the previous one's generator.
    pub(super) fn independent(self, env: usize, unseeded: PoolEntropy) -> Self {
        match self {
            Seeds::Continue { first } => {
                let draws = first.map_or_else(|| unseeded.seeds(env), later_seeds);
                Seeds::Independent { first, draws }
            }
            seeded => seeded,
        }
    }

    /// The next episode's seed; `None` continues the environment's generator.
    pub(super) fn next(&mut self) -> Option<u64> {
        match self {
            Seeds::Continue { first } => first.take(),
            Seeds::Independent { first, draws } => first.take().or_else(|| Some(draws.integers(0, i64::MAX) as u64)),
            Seeds::Range { start, step, count, draws } => Some(*start + *step * draws.integers(0, *count) as u64),
            Seeds::List { seeds, next, stride, .. } => {
                let seed = seeds[*next];
                *next = (*next + *stride) % seeds.len();
                Some(seed)
            }
        }
    }

    /// Restarts from a seed that was given to a reset, which alone determines the seeds of later episodes.
    pub(super) fn restart(&mut self, seed: u64) {
        match self {
            Seeds::Continue { first } => *first = None,
            Seeds::Range { draws, .. } => *draws = later_seeds(seed),
            Seeds::Independent { first, draws } => {
                *first = None;
                *draws = later_seeds(seed);
            }
            Seeds::List { first, next, .. } => *next = *first,
        }
    }

    /// The part of a snapshot that determines the seeds of later episodes.
    pub(super) fn save(&self) -> SavedSeeds {
        match self {
            Seeds::Continue { first } => SavedSeeds::Continue { first: *first },
            Seeds::Range { draws, .. } => SavedSeeds::Range { draws: draws.clone() },
            Seeds::Independent { first, draws } => SavedSeeds::Independent { first: *first, draws: draws.clone() },
            Seeds::List { next, .. } => SavedSeeds::List { next: *next },
        }
    }

    /// Continues the snapshot's seeds. Does nothing if the snapshot has another kind of [`Seeding`].
    pub(super) fn restore(&mut self, saved: SavedSeeds) {
        match (self, saved) {
            (Seeds::Continue { first }, SavedSeeds::Continue { first: saved }) => *first = saved,
            (Seeds::Range { draws, .. }, SavedSeeds::Range { draws: saved }) => *draws = saved,
            (Seeds::Independent { first, draws }, SavedSeeds::Independent { first: saved, draws: drawn }) => {
                *first = saved;
                *draws = drawn;
            }
            (Seeds::List { seeds, next, .. }, SavedSeeds::List { next: saved }) => *next = saved % seeds.len(),
            _ => {}
        }
    }
}

/// The generator that draws the seeds of the episodes that follow one with `seed`.
fn later_seeds(seed: u64) -> Generator {
    Generator::from_seed_sequence(&SeedSequence::new(seed).with_spawn_key(&[0]))
}

/// The position of an environment in its sequence of seeds.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum SavedSeeds {
    Continue { first: Option<u64> },
    Range { draws: Generator },
    List { next: usize },
    Independent { first: Option<u64>, draws: Generator },
}
