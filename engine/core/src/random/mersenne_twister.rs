//! The generator MT19937, and the draws of Python's `random` module and of `numpy.random`'s functions.

use serde::{Deserialize, Serialize};

/// Words of the state.
const WORDS: usize = 624;
const SHIFT: usize = 397;

/// MT19937, as Python's `random.Random` and numpy's `RandomState` use it. Environments whose original draws from these global
/// generators keep their own.
///
/// ```
/// use endless_gym_core::random::MersenneTwister;
///
/// // random.seed(7); random.randrange(100)
/// assert_eq!(MersenneTwister::from_python_seed(7).randbelow(100), 41);
/// ```
///
/// Makoto Matsumoto and Takuji Nishimura, "Mersenne Twister", ACM Transactions on Modeling and Computer Simulation 8 (1), 1998.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MersenneTwister {
    words: Vec<u32>,
    used: usize,
}

impl MersenneTwister {
    /// A new generator after `random.seed(seed)`.
    pub fn from_python_seed(seed: u64) -> Self {
        let mut random = MersenneTwister { words: Vec::new(), used: WORDS };
        random.seed_as_python(seed);
        random
    }

    /// A new generator after `numpy.random.seed(seed)`.
    pub fn from_numpy_seed(seed: u32) -> Self {
        let mut random = MersenneTwister { words: Vec::new(), used: WORDS };
        random.seed_as_numpy(seed);
        random
    }

    /// `random.seed(seed)` for an integer. Keeps the memory of the state.
    pub fn seed_as_python(&mut self, seed: u64) {
        let key = [seed as u32, (seed >> 32) as u32];
        let key = if key[1] == 0 { &key[..1] } else { &key[..] };
        self.seed_as_numpy(19_650_218);
        let words = &mut self.words;
        let mixed = |words: &[u32], at: usize, factor: u32| {
            let last = words[at - 1];
            words[at] ^ (last ^ last >> 30).wrapping_mul(factor)
        };
        let mut at = 1;
        let next = |words: &mut [u32], at: usize| {
            if at + 1 < WORDS {
                return at + 1;
            }
            words[0] = words[WORDS - 1];
            1
        };
        for number in (0..key.len()).cycle().take(WORDS) {
            words[at] = mixed(words, at, 1_664_525).wrapping_add(key[number]).wrapping_add(number as u32);
            at = next(words, at);
        }
        for _ in 1..WORDS {
            words[at] = mixed(words, at, 1_566_083_941).wrapping_sub(at as u32);
            at = next(words, at);
        }
        words[0] = 1 << 31;
    }

    /// `numpy.random.seed(seed)`. Keeps the memory of the state.
    pub fn seed_as_numpy(&mut self, seed: u32) {
        let next = |&(at, word): &(u32, u32)| {
            Some((at + 1, (word ^ word >> 30).wrapping_mul(1_812_433_253).wrapping_add(at + 1)))
        };
        self.words.clear();
        self.words.extend(std::iter::successors(Some((0, seed)), next).map(|(_, word)| word).take(WORDS));
        self.used = WORDS;
    }

    /// `random.randrange(count)`, and the index of `random.choice` among `count` items: a uniform number in `0..count`; 0 without a
    /// draw if `count` is 0.
    pub fn randbelow(&mut self, count: u32) -> u32 {
        let Some(shift) = count.checked_ilog2().map(|bits| 31 - bits) else { return 0 };
        loop {
            let value = self.next_u32() >> shift;
            if value < count {
                return value;
            }
        }
    }

    /// `numpy.random.shuffle(items)`.
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for last in (1..items.len()).rev() {
            let mask = u32::MAX >> (last as u32).leading_zeros();
            let other = loop {
                let value = (self.next_u32() & mask) as usize;
                if value <= last {
                    break value;
                }
            };
            items.swap(last, other);
        }
    }

    /// Whether a deserialised state has the right size, and is not the one that returns only zeros.
    pub fn is_valid(&self) -> bool {
        self.words.len() == WORDS
            && (1..=WORDS).contains(&self.used)
            && (self.words[0] >> 31 == 1 || self.words[1..].iter().any(|word| *word != 0))
    }

    fn next_u32(&mut self) -> u32 {
        if self.used == WORDS {
            self.twist();
        }
        let word = self.words[self.used];
        self.used += 1;
        let word = word ^ word >> 11;
        let word = word ^ word << 7 & 0x9d2c_5680;
        let word = word ^ word << 15 & 0xefc6_0000;
        word ^ word >> 18
    }

    #[cold]
    fn twist(&mut self) {
        for at in 0..WORDS {
            let joined = self.words[at] & 1 << 31 | self.words[(at + 1) % WORDS] & !(1 << 31);
            let odd = if joined & 1 == 1 { 0x9908_b0df } else { 0 };
            self.words[at] = self.words[(at + SHIFT) % WORDS] ^ joined >> 1 ^ odd;
        }
        self.used = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Python's `random.seed(seed); [random.randrange(n) for n in (1, 2, 7, 100, 2**31 + 1)] * 300`, the last ten, and the numbers after
    /// `numpy.random.seed(seed)` and 300 shuffles of nine.
    const CASES: &[(u64, [u32; 5], [u32; 9])] = &[
        (0, [0, 0, 1, 2, 108087608], [2, 6, 4, 8, 7, 1, 3, 0, 5]),
        (1, [0, 1, 4, 35, 752294986], [1, 2, 6, 4, 7, 8, 0, 5, 3]),
        (7, [0, 0, 2, 32, 1213728670], [4, 5, 0, 8, 6, 3, 2, 1, 7]),
        (2147483648, [0, 0, 5, 0, 1727774411], [3, 2, 0, 7, 6, 5, 1, 4, 8]),
        (4294967295, [0, 1, 3, 56, 1850316476], [5, 0, 4, 1, 7, 2, 8, 3, 6]),
        (4294967296, [0, 1, 2, 93, 1543075382], [2, 6, 4, 8, 7, 1, 3, 0, 5]),
        (9223372036854788153, [0, 0, 6, 72, 1253660877], [7, 8, 1, 5, 6, 2, 0, 3, 4]),
        (18446744073709551615, [0, 1, 5, 16, 1130193626], [5, 0, 4, 1, 7, 2, 8, 3, 6]),
    ];

    #[test]
    fn draws_equal_pythons_and_numpys() {
        for (seed, drawn, shuffled) in CASES {
            let mut python = MersenneTwister::from_python_seed(*seed);
            let mut last = [0; 5];
            for _ in 0..300 {
                last = [1, 2, 7, 100, (1 << 31) + 1].map(|count| python.randbelow(count));
            }
            assert_eq!(last, *drawn, "seed {seed}");
            let mut numpy = MersenneTwister::from_numpy_seed(*seed as u32);
            let mut items: Vec<u32> = (0..9).collect();
            (0..300).for_each(|_| numpy.shuffle(&mut items));
            assert_eq!(items, shuffled, "seed {seed}");
        }
    }
}
