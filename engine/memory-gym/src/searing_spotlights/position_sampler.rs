//! Random positions for agent, coins and exit, with a minimum distance between them.
//!
//! Source: `GridPositionSampler` of the original's `pygame_assets.py`, which searches an array of all pixels. Here a row of
//! pixels is a bit set, so that 84 positions are counted at a time.

use crate::screen::SCREEN;
use endless_gym_core::random::Generator;

/// All positions of one row.
const ROW: u128 = (1 << SCREEN) - 1;

/// Draws positions (pixels of the screen) that keep a distance from earlier ones.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct PositionSampler {
    /// The blocked positions, row by row: bit `x` of row `y`.
    taken: [u128; SCREEN],
    /// Number of free positions of each row.
    free: [u8; SCREEN],
}

impl PositionSampler {
    /// A sampler with all positions free.
    pub fn new() -> Self {
        PositionSampler { taken: [0; SCREEN], free: [SCREEN as u8; SCREEN] }
    }

    /// Blocks all positions that are less than `radius` pixels away from `(x, y)`.
    pub fn block(&mut self, (x, y): (i32, i32), radius: i32) {
        for away in 0..radius {
            let reach = (radius * radius - away * away - 1).isqrt();
            let near = first_positions(x + reach + 1) & !first_positions(x - reach);
            self.block_row(y - away, near);
            self.block_row(y + away, near);
        }
    }

    /// Blocks positions of a row, if the row exists.
    #[inline]
    fn block_row(&mut self, row: i32, positions: u128) {
        if let Some(taken) = self.taken.get_mut(row as usize) {
            self.free[row as usize] -= (positions & !*taken).count_ones() as u8;
            *taken |= positions;
        }
    }

    /// Draws one of the free positions uniformly, and blocks the positions around it. If none is free, as with very many coins,
    /// all are freed first; the original raises an error in that case.
    pub fn sample(&mut self, radius: i32, random: &mut Generator) -> (i32, i32) {
        let mut count: u32 = self.free.iter().map(|free| u32::from(*free)).sum();
        if count == 0 {
            *self = PositionSampler::new();
            count = (SCREEN * SCREEN) as u32;
        }
        let mut number = random.integers(0, i64::from(count)) as u32;
        let mut position = (0, 0);
        for ((row, taken), free) in (0..).zip(&self.taken).zip(&self.free) {
            if number < u32::from(*free) {
                let mut positions = !taken & ROW;
                // Removes the free positions before the drawn one, which is then the lowest.
                (0..number).for_each(|_| positions &= positions - 1);
                position = (positions.trailing_zeros() as i32, row);
                break;
            }
            number -= u32::from(*free);
        }
        self.block(position, radius);
        position
    }
}

/// The positions of a row with `x` below `end`.
fn first_positions(end: i32) -> u128 {
    (1 << end.clamp(0, SCREEN as i32)) - 1
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The original's algorithm: all free pixels in a list.
    fn listed(blocked: &[((i32, i32), i32)]) -> Vec<(i32, i32)> {
        let size = SCREEN as i32;
        let near = |x: i32, y: i32| {
            blocked.iter().any(|&((a, b), radius)| (x - a) * (x - a) + (y - b) * (y - b) < radius * radius)
        };
        (0..size).flat_map(|y| (0..size).map(move |x| (x, y))).filter(|&(x, y)| !near(x, y)).collect()
    }

    proptest! {
        #[test]
        fn draws_from_the_list_of_free_pixels(
            seed: u64,
            blocked in prop::collection::vec(((-3..90_i32, -3..90_i32), 0..40_i32), 0..5),
            radius in 0..40_i32,
        ) {
            let mut sampler = PositionSampler::new();
            blocked.iter().for_each(|&(place, radius)| sampler.block(place, radius));
            let list = listed(&blocked);
            prop_assume!(!list.is_empty());
            let mut random = Generator::from_seed(seed);
            let expected = list[random.clone().integers(0, list.len() as i64) as usize];
            let found = sampler.sample(radius, &mut random);
            prop_assert_eq!(found, expected);
            let mut after = blocked.clone();
            after.push((found, radius));
            let counted: Vec<u32> = sampler.taken.iter().map(|taken| (!taken & ROW).count_ones()).collect();
            prop_assert_eq!(counted, sampler.free.map(u32::from));
            prop_assert_eq!(sampler.free.iter().map(|free| usize::from(*free)).sum::<usize>(), listed(&after).len());
        }
    }

    #[test]
    fn a_full_screen_starts_over() {
        let mut sampler = PositionSampler::new();
        sampler.block((42, 42), 200);
        let mut random = Generator::from_seed(1);
        let (x, y) = sampler.sample(10, &mut random);
        assert!((0..84).contains(&x) && (0..84).contains(&y));
        assert_ne!(sampler, PositionSampler::new());
    }
}
