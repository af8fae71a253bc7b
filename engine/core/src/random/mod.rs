//! numpy's random numbers, bit-exact: [`SeedSequence`] and [`Generator`] over PCG64.
//!
//! The original environments use `numpy.random.Generator(PCG64(SeedSequence(seed)))`, the generator of Gymnasium's
//! `np_random(seed)`. The same seed must give the same episodes here, so the draws, and the number of bits that each consumes,
//! equal those of numpy 1.26 and 2.x, which agree.
//!
//! # Stability
//!
//! [`Generator`] and [`EntropyError`] are part of the crate's interface. Everything else is public for the benchmarks and for
//! [`Environment`](crate::envs::Environment), and may change in any version.

mod entropy;
mod generator;
mod mersenne_twister;
mod seed_sequence;
mod ziggurat;

pub use entropy::{EntropyError, entropy};
pub use generator::Generator;
pub use mersenne_twister::MersenneTwister;
pub use seed_sequence::SeedSequence;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde::Deserialize;

    use super::{Generator, SeedSequence};

    /// numpy's results, recorded by `tests/random/record_random.py`.
    #[derive(Deserialize)]
    struct Cases {
        seedings: Vec<Seeding>,
        streams: Vec<Stream>,
    }

    #[derive(Deserialize)]
    struct Seeding {
        entropy: Vec<u32>,
        spawn_key: Vec<u32>,
        u32: [u32; 9],
        u64: [u64; 5],
    }

    #[derive(Deserialize)]
    struct Stream {
        seed: u64,
        spawn_key: Vec<u32>,
        draws: Vec<Draw>,
    }

    /// Arguments, then the drawn values; floats as their bits.
    #[derive(Deserialize)]
    #[serde(rename_all = "lowercase")]
    enum Draw {
        Integers(i64, i64, Vec<i64>),
        Choice(usize, usize),
        Uniform(u64, u64, u64),
        Random(u64),
        #[serde(rename = "random_f32")]
        RandomF32(u32),
        Normal(u64, u64, u64),
        /// Number of standard normals, and a checksum of their bits.
        Normals(usize, u64),
        Shuffle(Vec<usize>),
        Distinct(usize, Vec<usize>),
    }

    fn cases() -> Cases {
        serde_json::from_str(include_str!("../../tests/random/cases.json")).unwrap()
    }

    #[test]
    fn seed_sequences_equal_numpys() {
        for case in cases().seedings {
            let entropy = &case.entropy;
            let check = |sequence: SeedSequence| {
                let sequence = sequence.with_spawn_key(&case.spawn_key);
                assert_eq!(sequence.generate_state_u32(), case.u32, "{entropy:?}");
                assert_eq!(sequence.generate_state_u64(), case.u64, "{entropy:?}");
            };
            check(SeedSequence::from_words(entropy));
            let value = |words: &[u32]| words.iter().rev().fold(0, |value, &word| value << 32 | u128::from(word));
            if entropy.len() <= 4 {
                check(SeedSequence::from_u128(value(entropy)));
            }
            if entropy.len() <= 2 {
                check(SeedSequence::new(value(entropy) as u64));
            }
        }
    }

    #[test]
    fn spawn_keys_can_be_given_in_steps() {
        let seed = SeedSequence::new(3);
        assert_eq!(seed.with_spawn_key(&[1]).with_spawn_key(&[2]), seed.with_spawn_key(&[1, 2]));
        assert_ne!(seed, seed.with_spawn_key(&[0]));
        assert_eq!(seed, seed.with_spawn_key(&[]));
    }

    #[test]
    fn draws_equal_numpys() {
        let indices: Vec<usize> = (0..1000).collect();
        for case in cases().streams {
            let sequence = SeedSequence::new(case.seed).with_spawn_key(&case.spawn_key);
            let mut rng = Generator::from_seed_sequence(&sequence);
            if case.spawn_key.is_empty() {
                assert_eq!(rng, Generator::from_seed(case.seed));
            }
            for (at, draw) in case.draws.iter().enumerate() {
                let place = format!("seed {}, draw {at}", case.seed);
                match *draw {
                    Draw::Integers(low, high, ref expected) => {
                        for &value in expected {
                            assert_eq!(rng.integers(low, high), value, "{place}");
                        }
                    }
                    Draw::Choice(length, expected) => {
                        assert_eq!(*rng.choice(&indices[..length]), expected, "{place}");
                    }
                    Draw::Uniform(low, high, expected) => {
                        let drawn = rng.uniform(f64::from_bits(low), f64::from_bits(high));
                        assert_eq!(drawn.to_bits(), expected, "{place}");
                    }
                    Draw::Random(expected) => {
                        assert_eq!(rng.random().to_bits(), expected, "{place}");
                    }
                    Draw::RandomF32(expected) => {
                        assert_eq!(rng.random_f32().to_bits(), expected, "{place}");
                    }
                    Draw::Normal(mean, deviation, expected) => {
                        let drawn = rng.normal(f64::from_bits(mean), f64::from_bits(deviation));
                        assert_eq!(drawn.to_bits(), expected, "{place}");
                    }
                    Draw::Normals(count, expected) => {
                        let drawn = (0..count).map(|_| rng.standard_normal().to_bits());
                        assert_eq!(drawn.fold(0, |sum: u64, bits| sum.rotate_left(1) ^ bits), expected, "{place}");
                    }
                    Draw::Shuffle(ref expected) => {
                        let mut items = indices[..expected.len()].to_vec();
                        rng.shuffle(&mut items);
                        assert_eq!(&items, expected, "{place}");
                    }
                    Draw::Distinct(count, ref expected) => {
                        let mut drawn = vec![0; expected.len()];
                        rng.choice_without_replacement(count, &mut drawn);
                        assert_eq!(&drawn, expected, "{place}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_saved_generator_continues_its_draws() {
        let mut rng = Generator::from_seed(11);
        // One 32-bit draw buffers the high half of the word.
        rng.integers(0, 10);
        let saved = serde_json::to_string(&rng).unwrap();
        let mut restored: Generator = serde_json::from_str(&saved).unwrap();
        assert_eq!(restored, rng);
        for _ in 0..9 {
            assert_eq!(restored.integers(-45, 45), rng.integers(-45, 45));
            assert_eq!(restored.random(), rng.random());
        }
    }

    #[cfg(feature = "entropy")]
    #[test]
    fn unseeded_generators_differ() {
        assert_ne!(super::entropy().unwrap(), super::entropy().unwrap());
    }

    #[test]
    fn ranges_of_one_and_empty_ranges_draw_nothing() {
        let untouched = Generator::from_seed(5);
        let mut rng = untouched.clone();
        assert_eq!(rng.integers(7, 8), 7);
        assert_eq!(rng.integers(7, 7), 7);
        assert_eq!(rng.integers(7, -7), 7);
        assert_eq!(rng.integers(i64::MAX, i64::MIN), i64::MAX);
        assert_eq!(rng.choice(&["only"]), &"only");
        assert_eq!(rng, untouched);
    }

    #[test]
    #[should_panic(expected = "cannot take 4 different numbers out of 3")]
    fn too_many_different_numbers_panic() {
        Generator::from_seed(0).choice_without_replacement(3, &mut [0; 4]);
    }

    #[test]
    #[should_panic(expected = "index out of bounds")]
    fn a_choice_from_nothing_panics() {
        Generator::from_seed(0).choice::<u8>(&[]);
    }

    proptest! {
        #[test]
        fn integers_stay_in_range(seed: u64, low: i64, high: i64, draws in 1..40_usize) {
            let mut rng = Generator::from_seed(seed);
            for _ in 0..draws {
                let value = rng.integers(low, high);
                prop_assert!(value == low || (low..high).contains(&value));
            }
        }

        #[test]
        fn floats_stay_in_range(seed: u64, low in -1e6..1e6_f64, length in 0.0..1e6_f64) {
            let mut rng = Generator::from_seed(seed);
            prop_assert!((0.0..1.0).contains(&rng.random()));
            let value = rng.uniform(low, low + length);
            prop_assert!((low..=low + length).contains(&value));
        }
    }
}
