//! numpy's seeding: mixes entropy of any size into a small pool, and derives initial states from it.

use std::array;

/// Number of 32-bit words in the pool, numpy's default.
const POOL_SIZE: usize = 4;

/// The hash for words that are mixed into the pool.
const ABSORB: Hash = Hash { constant: 0x43b0_d7e5, step: 0x931e_8875 };
/// The hash for words that are generated from the pool.
const GENERATE: Hash = Hash { constant: 0x8b51_f9dd, step: 0x58f3_8ded };
/// Weights of the two words that are mixed into one.
const MIX_LEFT: u32 = 0xca01_f9dd;
const MIX_RIGHT: u32 = 0x4973_f715;

/// `numpy.random.SeedSequence`: turns a seed into well-mixed words for the initial state of a bit generator.
///
/// The pool of 4 words is the whole state, so the value is small and cheap to copy.
///
/// ```
/// use endless_gym_core::random::{Generator, SeedSequence};
///
/// // numpy.random.SeedSequence(42).generate_state(2)
/// assert_eq!(SeedSequence::new(42).generate_state_u32(), [3444837047, 2669555309]);
/// // numpy.random.default_rng(numpy.random.SeedSequence(42, spawn_key=(1,)))
/// let rng = Generator::from_seed_sequence(&SeedSequence::new(42).with_spawn_key(&[1]));
/// assert_ne!(rng, Generator::from_seed(42));
/// ```
///
/// Source: `numpy/random/bit_generator.pyx` (numpy 1.26 and 2.x), after Melissa O'Neill's
/// `seed_seq_fe`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SeedSequence {
    pool: [u32; POOL_SIZE],
    hash: Hash,
}

impl SeedSequence {
    /// `SeedSequence(entropy)`; every value is a valid seed.
    pub fn new(entropy: u64) -> Self {
        Self::from_u128(entropy.into())
    }

    /// `SeedSequence(entropy)` for up to 128 bits, the size that numpy draws from the operating system when no seed is given.
    pub fn from_u128(entropy: u128) -> Self {
        // Leading zero words make no difference: numpy pads with zeros up to the pool's size.
        Self::from_words(&array::from_fn::<_, POOL_SIZE, _>(|index| (entropy >> (32 * index)) as u32))
    }

    /// `SeedSequence(entropy)` for entropy of any size, given as its 32-bit words, least significant first. Equals numpy's for
    /// a list of such words as well. An empty slice is equivalent to 0.
    pub fn from_words(entropy: &[u32]) -> Self {
        let mut hash = ABSORB;
        let mut pool: [u32; POOL_SIZE] = array::from_fn(|index| hash.next(entropy.get(index).copied().unwrap_or(0)));
        for source in 0..POOL_SIZE {
            for target in (0..POOL_SIZE).filter(|&target| target != source) {
                pool[target] = mix(pool[target], hash.next(pool[source]));
            }
        }
        let rest = entropy.get(POOL_SIZE..).unwrap_or_default();
        Self { pool, hash }.absorb(rest)
    }

    /// `SeedSequence(entropy, spawn_key=key)`: an independent sequence for each key of the same entropy. If the sequence
    /// already has a key, the new one is appended, as in numpy's `spawn`. numpy splits a key above 2³² - 1 into two words,
    /// least significant first.
    #[must_use]
    pub fn with_spawn_key(self, key: &[u32]) -> Self {
        // numpy pads short entropy to the pool's size before it appends the key, so a key is always absorbed after the pool has
        // been filled.
        self.absorb(key)
    }

    /// `generate_state(N, numpy.uint32)`. The sequence does not change: every call returns the same words, and the words of a
    /// smaller `N` are a prefix of those of a larger one.
    pub fn generate_state_u32<const N: usize>(&self) -> [u32; N] {
        let mut hash = GENERATE;
        array::from_fn(|index| hash.next(self.pool[index % POOL_SIZE]))
    }

    /// `generate_state(N, numpy.uint64)`: the 32-bit words in pairs, the low half first.
    pub fn generate_state_u64<const N: usize>(&self) -> [u64; N] {
        let mut hash = GENERATE;
        array::from_fn(|pair| {
            let [low, high] = [2 * pair, 2 * pair + 1].map(|index| u64::from(hash.next(self.pool[index % POOL_SIZE])));
            low | high << 32
        })
    }

    /// Mixes further words into a pool that has been filled.
    fn absorb(mut self, words: &[u32]) -> Self {
        for &word in words {
            for slot in &mut self.pool {
                *slot = mix(*slot, self.hash.next(word));
            }
        }
        self
    }
}

/// A hash of words whose constant changes with each word.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Hash {
    constant: u32,
    step: u32,
}

impl Hash {
    fn next(&mut self, word: u32) -> u32 {
        let mixed = word ^ self.constant;
        self.constant = self.constant.wrapping_mul(self.step);
        fold(mixed.wrapping_mul(self.constant))
    }
}

fn mix(left: u32, right: u32) -> u32 {
    let left = left.wrapping_mul(MIX_LEFT);
    fold(left.wrapping_sub(right.wrapping_mul(MIX_RIGHT)))
}

/// Mixes the high half, where multiplication mixes best, into the low half.
fn fold(word: u32) -> u32 {
    word ^ word >> 16
}
