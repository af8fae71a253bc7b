//! Policies over actions with one or more branches, each a categorical distribution.
//!
//! Shapes: M steps, B branches with `choices[b]` choices each, C choices in total. Logits and log-probabilities (M, C) have the
//! branches side by side. Actions (M, B) are the numbers of the choices taken.

/// Replaces logits by log-probabilities: `l_i = x_i - log sum_j exp(x_j)`, within each branch.
pub fn log_softmax(logits: &mut [f32], choices: &[usize]) {
    for (start, size) in starts(logits.len(), choices) {
        let branch = &mut logits[start..start + size];
        let largest = branch.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let log_sum = branch.iter().map(|x| (x - largest).exp()).sum::<f32>().ln() + largest;
        branch.iter_mut().for_each(|x| *x -= log_sum);
    }
}

/// The log-probabilities of the actions taken, `taken` (M, B). Panics if an action is not among the choices, or the
/// shapes do not fit.
pub fn log_prob(log_probs: &[f32], choices: &[usize], actions: &[usize], taken: &mut [f32]) {
    for (i, (start, size)) in starts(log_probs.len(), choices).enumerate() {
        taken[i] = log_probs[start..start + size][actions[i]];
    }
}

/// The entropy of the policy at each step (M,): `- sum_i exp(l_i) l_i`, summed over the branches.
pub fn entropy(log_probs: &[f32], choices: &[usize], entropy: &mut [f32]) {
    for (row, entropy) in log_probs.chunks_exact(choices.iter().sum()).zip(entropy) {
        *entropy = -row.iter().map(|l| l.exp() * l).sum::<f32>();
    }
}

/// Takes the choice with the largest sum of log-probability and noise in each branch. With independent noise from [`gumbel`], it is a
/// sample of the policy (the Gumbel-max trick); without noise, the most likely choice.
pub fn sample(log_probs: &[f32], choices: &[usize], noise: Option<&[f32]>, actions: &mut [usize]) {
    for (action, (start, size)) in actions.iter_mut().zip(starts(log_probs.len(), choices)) {
        let score = |i: usize| log_probs[start + i] + noise.map_or(0.0, |noise| noise[start + i]);
        *action = (1..size).fold(0, |best, i| if score(i) > score(best) { i } else { best });
    }
}

/// Gumbel noise `-log(-log(u))` from a number `u` that is uniform in [0, 1).
pub fn gumbel(u: f32) -> f32 {
    -(-u.max(f32::MIN_POSITIVE).ln()).ln()
}

/// Computes the gradient of the logits from those of the log-probabilities taken (M, B) and of the entropies (M,).
///
/// Within a branch with probabilities `p = exp(l)`, entropy H, action a, and gradients g of `l_a` and h of H:
///
/// ```text
/// dx_i = g ([i = a] - p_i) - h p_i (l_i + H)
/// ```
pub fn backward(
    log_probs: &[f32],
    choices: &[usize],
    actions: &[usize],
    grad_taken: &[f32],
    grad_entropy: &[f32],
    grad_logits: &mut [f32],
) {
    for (i, (start, size)) in starts(log_probs.len(), choices).enumerate() {
        let (l, grad) = (&log_probs[start..start + size], &mut grad_logits[start..start + size]);
        let entropy = -l.iter().map(|l| l.exp() * l).sum::<f32>();
        for (grad, l) in grad.iter_mut().zip(l) {
            *grad = -l.exp() * (grad_taken[i] + grad_entropy[i / choices.len()] * (l + entropy));
        }
        grad[actions[i]] += grad_taken[i];
    }
}

/// The first index and the size of each branch of each row of a matrix with `length` numbers.
fn starts(length: usize, choices: &[usize]) -> impl Iterator<Item = (usize, usize)> {
    let total: usize = choices.iter().sum();
    (0..length / total).flat_map(move |row| {
        choices.iter().scan(row * total, |start, size| {
            *start += size;
            Some((*start - size, *size))
        })
    })
}
