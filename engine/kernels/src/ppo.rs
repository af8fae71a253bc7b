//! The losses of proximal policy optimisation (Schulman et al., 2017), as the Python agents define them in `losses.py`. Each is a mean
//! over M steps or their branches, and has its gradient.

use std::cmp::Ordering;

/// The negated clipped surrogate objective; the mean over all branches of all steps, each clipped separately.
///
/// With the ratio `r = exp(l - l_old)` and the advantage A: `- mean of min(r A, clip(r, 1 - clip_range, 1 + clip_range) A)`.
///
/// # Arguments
///
/// - `log_probs`, `old_log_probs`: log-probabilities of the actions under the current policy and the one that acted, (M, B)
/// - `advantages`: (M,)
/// - `grad`: overwritten with the gradient of `log_probs`, (M, B)
pub fn policy_loss(
    log_probs: &[f32],
    old_log_probs: &[f32],
    advantages: &[f32],
    clip_range: f32,
    grad: &mut [f32],
) -> f32 {
    let (count, branches) = (log_probs.len() as f64, log_probs.len() / advantages.len());
    let mut sum = 0.0;
    for (i, (log_prob, old)) in log_probs.iter().zip(old_log_probs).enumerate() {
        let (ratio, advantage) = ((log_prob - old).exp(), advantages[i / branches]);
        let clipped = ratio.clamp(1.0 - clip_range, 1.0 + clip_range);
        // Inside the range both are equal. Outside it, the clipped one has no gradient.
        let is_clipped = clipped != ratio && clipped * advantage <= ratio * advantage;
        sum -= f64::from(if is_clipped { clipped * advantage } else { ratio * advantage });
        grad[i] = if is_clipped { 0.0 } else { -ratio * advantage / count as f32 };
    }
    (sum / count) as f32
}

/// The clipped value loss: the mean of the larger of the squared errors of the value and of the clipped value.
///
/// With the value v, and c the value clipped to `v_old - clip_range` to `v_old + clip_range`: `max((v - R)^2, (c - R)^2)`.
///
/// # Arguments
///
/// - `values`, `old_values`: current estimates, and those while acting, (M,)
/// - `returns`: targets R, (M,)
/// - `grad`: overwritten with the gradient of `values`, (M,)
pub fn value_loss(values: &[f32], old_values: &[f32], returns: &[f32], clip_range: f32, grad: &mut [f32]) -> f32 {
    let count = values.len() as f64;
    let mut sum = 0.0;
    for (i, value) in values.iter().enumerate() {
        let change = value - old_values[i];
        let clipped = old_values[i] + change.clamp(-clip_range, clip_range);
        let (error, clipped_error) = (value - returns[i], clipped - returns[i]);
        let (square, clipped_square) = (error * error, clipped_error * clipped_error);
        sum += f64::from(if clipped_square > square { clipped_square } else { square });
        // A value that is clipped has no gradient, as one at the bound. If both squares are equal, PyTorch takes the mean of their gradients.
        let share = match square.total_cmp(&clipped_square) {
            _ if change.abs() < clip_range => 1.0,
            Ordering::Greater => 1.0,
            Ordering::Equal => 0.5,
            Ordering::Less => 0.0,
        };
        grad[i] = share * 2.0 * error / count as f32;
    }
    (sum / count) as f32
}
