//! Recurrent minibatches, as the Python agents' `recurrent.py` and `memory.py` make them.
//!
//! A segment is cut into sequences of the same length, which are named by the rows of their first steps. A sequence starts from the
//! hidden state that was stored while acting, and gradients stop at its start and at those of episodes within it. Whole sequences are
//! shuffled into minibatches of about the same number.

use endless_gym_core::random::Generator;

use crate::threads::part;

/// The sequences of a segment of `steps` steps, a multiple of `length`: by environment, then by step.
pub fn sequences(steps: usize, num_envs: usize, length: usize) -> Vec<usize> {
    (0..num_envs).flat_map(|env| (0..steps).step_by(length).map(move |start| start * num_envs + env)).collect()
}

/// The rows of sequences, step by step.
pub fn rows(sequences: &[usize], num_envs: usize, length: usize) -> impl Iterator<Item = usize> {
    (0..length).flat_map(move |step| sequences.iter().map(move |first| first + step * num_envs))
}

/// Shuffles sequences and splits them into parts of about the same size. No part is empty: with too few sequences there are fewer parts.
pub fn minibatches(sequences: &[usize], count: usize, random: &mut Generator) -> Vec<Vec<usize>> {
    let (mut order, count) = (sequences.to_vec(), count.min(sequences.len()));
    random.shuffle(&mut order);
    (0..count).map(|i| order[part(order.len(), i, count)].to_vec()).collect()
}

/// Sequences for one shard of a minibatch, at least: with fewer rows a product is less efficient.
const SEQUENCES_PER_SHARD: usize = 6;
/// Shards of a minibatch, at most.
const MAX_SHARDS: usize = 8;

/// Divides a minibatch into shards of about the same size, which threads compute at the same time. The division depends on the number of
/// sequences only, so the sums of gradients do not depend on the number of threads.
pub fn shards(minibatch: &[usize]) -> Vec<Vec<usize>> {
    let count = (minibatch.len() / SEQUENCES_PER_SHARD).clamp(1, MAX_SHARDS);
    (0..count).map(|shard| minibatch.iter().skip(shard).step_by(count).copied().collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn minibatches_and_shards_have_each_step_once() {
        let all = sequences(64, 10, 16);
        assert_eq!(all[..5], [0, 160, 320, 480, 1]);
        assert_eq!(rows(&all[3..5], 10, 2).collect::<Vec<_>>(), [480, 1, 490, 11]);
        let parts = minibatches(&all, 3, &mut Generator::from_seed(1));
        assert_eq!(parts.iter().map(Vec::len).collect::<Vec<_>>(), [13, 13, 14]);
        let shards: Vec<_> = parts.iter().flat_map(|part| shards(part)).collect();
        assert_eq!(shards.len(), 6);
        let mut found: Vec<_> = shards.iter().flat_map(|shard| rows(shard, 10, 16)).collect();
        found.sort_unstable();
        assert!(found.into_iter().eq(0..640));
        assert_eq!(minibatches(&all[..2], 4, &mut Generator::from_seed(1)).len(), 2);
    }
}
