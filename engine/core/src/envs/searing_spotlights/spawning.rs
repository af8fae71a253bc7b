//! Where agent, coins and exit appear: places drawn apart from each other.
//!
//! Source: `GridPositionSampler` of the original's `pygame_assets.py`, which searches an array of all pixels. Here a row of
//! pixels is one number, so that places are counted 84 at a time.

use crate::envs::SCREEN;
use crate::random::Generator;

/// All places of one row.
const ROW: u128 = (1 << SCREEN) - 1;

/// Which places (pixels of the screen) are too near to something that is there already.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Places {
    /// Row by row, bit `x` for the place `(x, y)`.
    taken: [u128; SCREEN],
    /// Free places of each row.
    free: [u8; SCREEN],
}

impl Places {
    /// Every place is free.
    pub fn new() -> Self {
        Places { taken: [0; SCREEN], free: [SCREEN as u8; SCREEN] }
    }

    /// Takes all places that are less than `radius` pixels away from `(x, y)`.
    pub fn block(&mut self, (x, y): (i32, i32), radius: i32) {
        for away in 0..radius {
            let reach = (radius * radius - away * away - 1).isqrt();
            let near = first_places(x + reach + 1) & !first_places(x - reach);
            self.take(y - away, near);
            self.take(y + away, near);
        }
    }

    /// Takes some places of a row, if there is such a row.
    #[inline]
    fn take(&mut self, row: i32, places: u128) {
        if let Some(taken) = self.taken.get_mut(row as usize) {
            self.free[row as usize] -= (places & !*taken).count_ones() as u8;
            *taken |= places;
        }
    }

    /// Draws one of the free places, each as likely as another, and takes those around it. Where none is free, as with very
    /// many coins, all are: there the original raises an error.
    pub fn sample(&mut self, radius: i32, random: &mut Generator) -> (i32, i32) {
        let mut count: u32 = self.free.iter().map(|free| u32::from(*free)).sum();
        if count == 0 {
            *self = Places::new();
            count = (SCREEN * SCREEN) as u32;
        }
        let mut number = random.integers(0, i64::from(count)) as u32;
        let mut place = (0, 0);
        for ((row, taken), free) in (0..).zip(&self.taken).zip(&self.free) {
            if number < u32::from(*free) {
                let mut places = !taken & ROW;
                // Without the free places before it, it is the lowest.
                (0..number).for_each(|_| places &= places - 1);
                place = (places.trailing_zeros() as i32, row);
                break;
            }
            number -= u32::from(*free);
        }
        self.block(place, radius);
        place
    }
}

/// The places of a row whose `x` is below `end`.
fn first_places(end: i32) -> u128 {
    (1 << end.clamp(0, SCREEN as i32)) - 1
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The original's way: all free pixels in a list.
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
            let mut places = Places::new();
            blocked.iter().for_each(|&(place, radius)| places.block(place, radius));
            let list = listed(&blocked);
            prop_assume!(!list.is_empty());
            let mut random = Generator::from_seed(seed);
            let expected = list[random.clone().integers(0, list.len() as i64) as usize];
            let found = places.sample(radius, &mut random);
            prop_assert_eq!(found, expected);
            let mut after = blocked.clone();
            after.push((found, radius));
            let counted: Vec<u32> = places.taken.iter().map(|taken| (!taken & ROW).count_ones()).collect();
            prop_assert_eq!(counted, places.free.map(u32::from));
            prop_assert_eq!(places.free.iter().map(|free| usize::from(*free)).sum::<usize>(), listed(&after).len());
        }
    }

    #[test]
    fn a_full_screen_starts_over() {
        let mut places = Places::new();
        places.block((42, 42), 200);
        let mut random = Generator::from_seed(1);
        let (x, y) = places.sample(10, &mut random);
        assert!((0..84).contains(&x) && (0..84).contains(&y));
        assert_ne!(places, Places::new());
    }
}
