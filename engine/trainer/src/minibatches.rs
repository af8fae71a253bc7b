//! Recurrent minibatches, as the Python agents' `recurrent.py` and `memory.py` make them.
//!
//! A segment is cut into sequences after every `sequence_length` steps, and for a GRU at the start of each episode. A sequence starts
//! from the hidden state that was stored while acting, and gradients stop at its start. Whole sequences are shuffled into minibatches of
//! about the same number of steps.

use std::cmp::Reverse;

use endless_gym_core::random::Generator;

/// Consecutive steps of one environment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sequence {
    /// Number of the environment.
    pub env: usize,
    /// First step in the segment.
    pub start: usize,
    /// Number of steps.
    pub length: usize,
}

/// The sequences of a segment, by environment and step. `starts` (T N,) marks the steps before which an episode is cut off.
pub fn sequences(starts: &[bool], num_envs: usize, sequence_length: usize) -> Vec<Sequence> {
    let (steps, mut found) = (starts.len() / num_envs, Vec::new());
    for env in 0..num_envs {
        let mut start = 0;
        for step in 1..=steps {
            if step == steps || step % sequence_length == 0 || starts[step * num_envs + env] {
                found.push(Sequence { env, start, length: step - start });
                start = step;
            }
        }
    }
    found
}

/// Shuffles sequences and splits them into parts of about the same number of steps. No part is empty: with too few sequences there are
/// fewer parts.
pub fn minibatches(sequences: &[Sequence], count: usize, random: &mut Generator) -> Vec<Vec<Sequence>> {
    let mut order = sequences.to_vec();
    random.shuffle(&mut order);
    let total: usize = order.iter().map(|sequence| sequence.length).sum();
    let mut parts = vec![Vec::new(); count];
    let mut before = 0;
    for sequence in order {
        // A sequence belongs to the part that contains the middle of its interval among all steps.
        let middle = 2 * before + sequence.length;
        parts[middle * count / (2 * total)].push(sequence);
        before += sequence.length;
    }
    parts.retain(|part| !part.is_empty());
    // Longer ones first, as packed sequences need them.
    parts.iter_mut().for_each(|part| part.sort_by_key(|sequence| Reverse(sequence.length)));
    parts
}

/// Sequences for one shard of a minibatch, at least: with fewer rows a product is less efficient.
const SEQUENCES_PER_SHARD: usize = 6;
/// Shards of a minibatch, at most.
const MAX_SHARDS: usize = 8;

/// Divides a minibatch into shards of about the same number of steps, which threads compute at the same time. The division depends on
/// the sequences only, so the sums of gradients do not depend on the number of threads.
pub fn shards(minibatch: &[Sequence]) -> Vec<Vec<Sequence>> {
    let count = (minibatch.len() / SEQUENCES_PER_SHARD).clamp(1, MAX_SHARDS);
    (0..count).map(|shard| minibatch.iter().skip(shard).step_by(count).copied().collect()).collect()
}

/// The rows of sequences in decreasing order of length, step by step, and the number of sequences that have each step.
pub fn packed(sequences: &[Sequence], num_envs: usize, rows: &mut Vec<usize>, sizes: &mut Vec<usize>) {
    rows.clear();
    sizes.clear();
    for step in 0..sequences.first().map_or(0, |longest| longest.length) {
        let size = sequences.partition_point(|sequence| sequence.length > step);
        rows.extend(sequences[..size].iter().map(|sequence| (sequence.start + step) * num_envs + sequence.env));
        sizes.push(size);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_segment_is_cut_at_episodes_and_after_each_length() {
        // Two environments; the second starts an episode at step 3.
        let starts = [true, false, false, false, false, false, false, true, false, false];
        let found = sequences(&starts, 2, 4);
        let expected = [(0, 0, 4), (0, 4, 1), (1, 0, 3), (1, 3, 1), (1, 4, 1)];
        assert_eq!(found, expected.map(|(env, start, length)| Sequence { env, start, length }));
        let (mut rows, mut sizes) = (Vec::new(), Vec::new());
        packed(&[found[0], found[2]], 2, &mut rows, &mut sizes);
        assert_eq!((rows, sizes), (vec![0, 1, 2, 3, 4, 5, 6], vec![2, 2, 2, 1]));
    }

    #[test]
    fn minibatches_and_shards_have_each_sequence_once() {
        let starts: Vec<bool> = (0..640).map(|row| row % 7 == 0).collect();
        let all = sequences(&starts, 10, 16);
        let parts = minibatches(&all, 4, &mut Generator::from_seed(1));
        let steps = |part: &[Sequence]| part.iter().map(|sequence| sequence.length).sum::<usize>();
        assert!(parts.iter().all(|part| steps(part).abs_diff(160) <= 16), "{parts:?}");
        let mut found: Vec<Sequence> = parts.iter().flat_map(|part| shards(part).concat()).collect();
        found.sort_by_key(|sequence| (sequence.env, sequence.start));
        assert_eq!(found, all);
        assert!(shards(&parts[0]).iter().flatten().count() > 12 && shards(&parts[0]).len() > 1);
        assert_eq!(minibatches(&all[..2], 4, &mut Generator::from_seed(1)).len(), 2);
    }
}
