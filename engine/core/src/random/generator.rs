//! The methods of numpy's `Generator` that the environments use.

use rand::Rng;
use rand_pcg::Pcg64;
use serde::{Deserialize, Serialize};

use super::seed_sequence::SeedSequence;
use super::ziggurat::{HEIGHT, INSIDE, TAIL, WIDTH};

/// Maximum number of redraws in rejection sampling, after which it takes a biased draw. numpy has no such limit. Fewer than
/// half of the draws are rejected, so no seed reaches it, but a deserialised state could.
const MAX_REDRAWS: u32 = 1024;

/// `numpy.random.Generator(PCG64(seed))`: the same draws from the same seed.
///
/// ```
/// use endless_gym_core::random::Generator;
///
/// // numpy.random.default_rng(42).integers(0, 10, 5) and .random()
/// let mut rng = Generator::from_seed(42);
/// assert_eq!([(); 5].map(|()| rng.integers(0, 10)), [0, 7, 6, 4, 4]);
/// assert_eq!(Generator::from_seed(42).random(), 0.7739560485559633);
/// ```
///
/// Sources: `numpy/random/_generator.pyx`, `src/distributions/distributions.c` and
/// `src/pcg64/pcg64.h` (numpy 1.26 and 2.x).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "UncheckedGenerator")]
pub struct Generator {
    /// The bit generator, with 64 bits per step.
    bits: Pcg64,
    /// The high half of a step whose low half was used by a 32-bit draw. The next 32-bit draw uses it, regardless of 64-bit
    /// draws in between. numpy's `has_uint32` and `uinteger`.
    kept: Option<u32>,
}

impl Generator {
    /// The generator that Gymnasium's `np_random(seed)` returns; every value is a valid seed.
    pub fn from_seed(seed: u64) -> Self {
        Self::from_seed_sequence(&SeedSequence::new(seed))
    }

    /// `Generator(PCG64(sequence))`.
    pub fn from_seed_sequence(sequence: &SeedSequence) -> Self {
        let [state_high, state_low, stream_high, stream_low] = sequence.generate_state_u64();
        let join = |high: u64, low: u64| u128::from(high) << 64 | u128::from(low);
        Self { bits: Pcg64::new(join(state_high, state_low), join(stream_high, stream_low)), kept: None }
    }

    /// `integers(low, high)`: a uniform integer in `low..high`, by numpy's `int64` path. numpy truncates float arguments
    /// towards zero.
    ///
    /// A range of one number returns that number and draws nothing. An empty range, for which numpy raises an error, returns
    /// `low` and draws nothing.
    #[inline]
    pub fn integers(&mut self, low: i64, high: i64) -> i64 {
        if low.saturating_add(1) >= high {
            return low;
        }
        // The size of the range: 2 to 2⁶⁴ - 1, exact despite the wrapping.
        let count = high.wrapping_sub(low) as u64;
        low.wrapping_add_unsigned(self.below(count))
    }

    /// `choice(items)`: one of the items, with equal probabilities. Draws nothing for a single item.
    ///
    /// # Panics
    ///
    /// If `items` is empty, for which numpy raises an error.
    #[inline]
    pub fn choice<'a, T>(&mut self, items: &'a [T]) -> &'a T {
        // A slice of sized items holds at most i64::MAX of them.
        &items[self.integers(0, items.len() as i64) as usize]
    }

    /// `random()`: a multiple of 2⁻⁵³ in `[0, 1)`.
    #[inline]
    pub fn random(&mut self) -> f64 {
        const STEP: f64 = 1.0 / (1_u64 << 53) as f64;
        (self.bits.next_u64() >> 11) as f64 * STEP
    }

    /// `uniform(low, high)`: `low + (high - low) * random()`, rounded after each operation as in numpy, so in `[low, high)` up
    /// to rounding. `high - low` must be finite and not negative, or the result is meaningless; numpy raises an error.
    #[inline]
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.random()
    }

    /// `random(dtype=float32)`: a multiple of 2⁻²⁴ in `[0, 1)`, from a 32-bit draw.
    #[inline]
    pub fn random_f32(&mut self) -> f32 {
        const STEP: f32 = 1.0 / (1_u32 << 24) as f32;
        (self.next_u32() >> 8) as f32 * STEP
    }

    /// `standard_normal()`, by the ziggurat method. Fewer than 1 % of the numbers need the exponential or the logarithm of the
    /// platform's mathematical library; these equal numpy's bit for bit where both use the same library.
    #[inline]
    pub fn standard_normal(&mut self) -> f64 {
        loop {
            let word = self.bits.next_u64();
            let layer = (word & 0xff) as usize;
            let inside = (word >> 9) & 0x000f_ffff_ffff_ffff;
            let x = f64::from_bits((inside as f64 * WIDTH[layer]).to_bits() | (word >> 8 & 1) << 63);
            if inside < INSIDE[layer] {
                return x;
            }
            if layer == 0 {
                return self.normal_tail(inside >> 8 & 1 != 0);
            }
            if (HEIGHT[layer - 1] - HEIGHT[layer]) * self.random() + HEIGHT[layer] < (-0.5 * x * x).exp() {
                return x;
            }
        }
    }

    #[cold]
    fn normal_tail(&mut self, is_negative: bool) -> f64 {
        loop {
            // numpy multiplies by the reciprocal, which rounds differently from a division.
            let x = -(1.0 / TAIL) * (-self.random()).ln_1p();
            let y = -(-self.random()).ln_1p();
            if y + y > x * x {
                return if is_negative { -(TAIL + x) } else { TAIL + x };
            }
        }
    }

    /// `normal(mean, deviation)`: `mean + deviation * standard_normal()`, rounded after each operation as in numpy.
    #[inline]
    pub fn normal(&mut self, mean: f64, deviation: f64) -> f64 {
        mean + deviation * self.standard_normal()
    }

    /// `shuffle(items)`, and with it `permutation`. Draws nothing for fewer than two items.
    #[inline]
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        let mut last = items.len().saturating_sub(1);
        for _ in 0..items.len().saturating_mul(MAX_REDRAWS as usize) {
            if last == 0 {
                break;
            }
            // numpy draws as many bits as `last` has, until they are in range. A draw that is not swaps the item with itself: a branch
            // would often be predicted wrongly.
            let drawn = (self.next_u32() & u32::MAX >> (last as u32).leading_zeros()) as usize;
            let is_in_range = drawn <= last;
            items.swap(last, if is_in_range { drawn } else { last });
            last -= usize::from(is_in_range);
        }
    }

    /// `choice(count, size, replace=False)`: fills `indices` with different numbers in `0..count`. numpy uses another algorithm
    /// for a `count` above 10,000.
    ///
    /// # Panics
    ///
    /// If `indices` is longer than `count`, for which numpy raises an error.
    pub fn choice_without_replacement(&mut self, count: usize, indices: &mut [usize]) {
        let size = indices.len();
        assert!(size <= count, "cannot take {size} different numbers out of {count}");
        // Robert Floyd's algorithm: a number that was drawn before is replaced by the largest possible one, which is new.
        for (at, largest) in (count - size..count).enumerate() {
            let drawn = self.integers(0, largest as i64 + 1) as usize;
            indices[at] = if indices[..at].contains(&drawn) { largest } else { drawn };
        }
        for last in (1..size).rev() {
            let other = self.integers(0, last as i64 + 1) as usize;
            indices.swap(last, other);
        }
    }

    /// A uniform number in `0..count`, for a count of 2 or more, from as many bits as numpy uses.
    #[inline]
    fn below(&mut self, count: u64) -> u64 {
        const WORDS: u64 = 1 << 32;
        if count < WORDS {
            self.below_u32(count as u32).into()
        } else if count == WORDS {
            self.next_u32().into()
        } else {
            self.below_u64(count)
        }
    }

    /// Lemire's method on 32-bit draws: the high half of `count * draw` is the result, and the low half identifies the few
    /// draws that would bias it and are repeated.
    ///
    /// Daniel Lemire, "Fast Random Integer Generation in an Interval",
    /// ACM Transactions on Modeling and Computer Simulation 29 (1), 2019.
    #[inline]
    fn below_u32(&mut self, count: u32) -> u32 {
        let mut product = u64::from(count) * u64::from(self.next_u32());
        // The threshold is below the count, so that most draws need no division.
        if (product as u32) < count {
            let threshold = count.wrapping_neg() % count;
            for _ in 0..MAX_REDRAWS {
                if (product as u32) >= threshold {
                    break;
                }
                product = u64::from(count) * u64::from(self.next_u32());
            }
        }
        (product >> 32) as u32
    }

    /// Lemire's method on 64-bit draws.
    #[inline]
    fn below_u64(&mut self, count: u64) -> u64 {
        let mut product = u128::from(count) * u128::from(self.bits.next_u64());
        if (product as u64) < count {
            let threshold = count.wrapping_neg() % count;
            for _ in 0..MAX_REDRAWS {
                if (product as u64) >= threshold {
                    break;
                }
                product = u128::from(count) * u128::from(self.bits.next_u64());
            }
        }
        (product >> 64) as u64
    }

    /// A 32-bit draw: one 64-bit output yields two 32-bit draws, the low half first.
    #[inline]
    fn next_u32(&mut self) -> u32 {
        self.kept.take().unwrap_or_else(|| {
            let word = self.bits.next_u64();
            self.kept = Some((word >> 32) as u32);
            word as u32
        })
    }
}

/// A deserialised generator whose increment has not been checked.
#[derive(Deserialize)]
struct UncheckedGenerator {
    bits: Pcg64,
    kept: Option<u32>,
}

impl TryFrom<UncheckedGenerator> for Generator {
    type Error = &'static str;

    /// Rejects an even increment. It shortens the period; at worst the generator only returns zeros, and the rejection sampling
    /// of [`Generator::integers`] would not end.
    fn try_from(unchecked: UncheckedGenerator) -> Result<Self, Self::Error> {
        let UncheckedGenerator { bits, kept } = unchecked;
        // `from_state` makes the increment odd.
        if Pcg64::from_state(bits.state(), bits.stream()) != bits {
            return Err("the increment of PCG64 must be odd");
        }
        Ok(Self { bits, kept })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejection_sampling_ends_on_any_state() {
        // With an even increment, which `from_state` and deserialising prevent, all draws are 0 and rejected.
        let stuck: Pcg64 = serde_json::from_str(r#"{"state":0,"increment":0}"#).unwrap();
        for high in [49, 1 << 33, i64::MAX - 1] {
            let mut generator = Generator { bits: stuck.clone(), kept: None };
            assert_eq!(generator.integers(0, high), 0);
        }
    }
}
