//! Policies, losses and the optimizer equal PyTorch's.

#[allow(clippy::excessive_precision)]
mod pytorch;

use endless_gym_core::random::Generator;
use endless_gym_kernels::orthogonal::orthogonal;
use endless_gym_kernels::{adamw, categorical, ppo};

/// Fails unless two slices are equal within 1e-5.
fn assert_close(actual: &[f32], expected: &[f32]) {
    assert_eq!(actual.len(), expected.len());
    for (a, e) in actual.iter().zip(expected) {
        assert!((a - e).abs() <= 1e-5 * (1.0 + e.abs()), "{actual:?}\ninstead of {expected:?}");
    }
}

/// Numbers from -1.375 to 1.375 that are exact in f32; as in `record.py`.
fn numbers(count: usize, seed: usize) -> Vec<f32> {
    (0..count).map(|i| (((37 * i * i + 5 * seed * i + 11 * seed) % 23) as f32 - 11.0) / 8.0).collect()
}

const CLIP_RANGE: f32 = 0.25;
const CHOICES: [usize; 2] = [3, 2];

#[test]
fn log_probabilities_entropies_and_their_gradients_equal_those_of_pytorch() {
    let (mut log_probs, actions) = (numbers(15, 5), [2, 0, 1, 1, 0, 0]);
    categorical::log_softmax(&mut log_probs, &CHOICES);
    let (mut taken, mut entropy, mut grad) = ([0.0; 6], [0.0; 3], [0.0; 15]);
    categorical::log_prob(&log_probs, &CHOICES, &actions, &mut taken);
    categorical::entropy(&log_probs, &CHOICES, &mut entropy);
    assert_close(&taken, &pytorch::TAKEN);
    assert_close(&entropy, &pytorch::ENTROPY);
    categorical::backward(&log_probs, &CHOICES, &actions, &numbers(6, 6), &numbers(3, 7), &mut grad);
    assert_close(&grad, &pytorch::LOGITS);
}

#[test]
fn losses_equal_those_of_the_python_agents() {
    let mut grad = [0.0; 16];
    let loss = ppo::policy_loss(&numbers(16, 8), &numbers(16, 9), &numbers(8, 10), CLIP_RANGE, &mut grad);
    assert_close(&[loss], &pytorch::POLICY);
    assert_close(&grad, &pytorch::POLICY_GRADIENT);
    // The numbers include clipped ratios of both kinds.
    assert!(grad.iter().filter(|x| **x == 0.0).count() >= 4 && grad.iter().filter(|x| **x != 0.0).count() >= 4);
    let mut grad = [0.0; 8];
    let loss = ppo::value_loss(&numbers(8, 11), &numbers(8, 12), &numbers(8, 13), 4.0 * CLIP_RANGE, &mut grad);
    assert_close(&[loss], &pytorch::VALUE);
    assert_close(&grad, &pytorch::VALUE_GRADIENT);
    assert!(grad.contains(&0.0) && grad.iter().any(|x| *x != 0.0));
}

#[test]
fn the_optimizer_and_the_clipped_norm_equal_those_of_pytorch() {
    let (mut parameters, mut optimizer, mut norms) = (numbers(4, 14), adamw::AdamW::new(4), [0.0; 3]);
    for (update, norm) in norms.iter_mut().enumerate() {
        let mut gradients = numbers(4, 15 + update);
        *norm = adamw::clip_norm(&mut gradients, 1.6);
        optimizer.update(&mut parameters, &gradients, 0.1);
    }
    assert_close(&parameters, &pytorch::ADAMW);
    assert_close(&norms, &pytorch::NORMS);
    assert!(norms.iter().any(|norm| *norm > 1.6) && norms.iter().any(|norm| *norm < 1.6), "{norms:?}");
}

#[test]
fn a_gradient_that_is_not_finite_stays_so_when_it_is_clipped() {
    let mut gradients = [1.0, f32::NAN];
    assert!(adamw::clip_norm(&mut gradients, 1.0).is_nan());
    assert!(gradients[0].is_nan() && gradients[1].is_nan());
}

#[test]
fn orthogonal_weights_equal_the_qr_decomposition_of_pytorch() {
    for (columns, expected) in [(4, pytorch::WIDE), (3, pytorch::TALL)] {
        let mut weight = numbers(12, 18);
        orthogonal(&mut weight, columns, 0.5);
        assert_close(&weight, &expected);
    }
}

#[test]
fn samples_have_the_probabilities_of_the_policy() {
    const SAMPLES: usize = 40_000;
    let mut random = Generator::from_seed(6);
    let mut row = numbers(5, 19);
    categorical::log_softmax(&mut row, &CHOICES);
    let (log_probs, mut actions) = (row.repeat(SAMPLES), vec![0; 2 * SAMPLES]);
    let noise: Vec<f32> = (0..5 * SAMPLES).map(|_| categorical::gumbel(random.random_f32())).collect();
    categorical::sample(&log_probs, &CHOICES, Some(&noise), &mut actions);
    for (choice, log_prob) in row.iter().enumerate() {
        let (branch, number) = if choice < 3 { (0, choice) } else { (1, choice - 3) };
        let count = actions.iter().skip(branch).step_by(2).filter(|action| **action == number).count();
        let (share, probability) = (count as f64 / SAMPLES as f64, f64::from(log_prob.exp()));
        // Five standard deviations.
        let limit = 5.0 * (probability * (1.0 - probability) / SAMPLES as f64).sqrt();
        assert!((share - probability).abs() < limit, "choice {choice}: {share} instead of {probability}");
    }
    categorical::sample(&row, &CHOICES, None, &mut actions[..2]);
    let largest = |l: &[f32]| (0..l.len()).max_by(|i, j| l[*i].total_cmp(&l[*j])).unwrap();
    assert_eq!(actions[..2], [largest(&row[..3]), largest(&row[3..])]);
}
