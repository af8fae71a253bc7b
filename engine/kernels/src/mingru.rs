//! minGRU (Feng et al., "Were RNNs all we needed?", 2024): a GRU whose gate and candidate depend on the input only.
//!
//! With the projected inputs `x = W input + b` and the state `h'` before a step:
//!
//! ```text
//! z = sigmoid(x_z)                update gate
//! h = (1 - z) h' + z x_h          x_h is the candidate
//! ```
//!
//! Shapes: M steps of S [`Sequences`], H units; projected inputs (M, 2 H) in the order z, h. The step from one state to the next has
//! no matrix product, so that it is as fast one step after the other as a parallel scan, and needs no logarithms.

use crate::functions::sigmoid;
use crate::sequences::{Sequences, parts, parts_mut};
use crate::vectors::vectorised;

/// What [`forward`] saves for [`backward`] per step and unit: z and `h'`.
pub const SAVED: usize = 2;

/// Computes the hidden states after all steps.
///
/// # Arguments
///
/// - `inputs`: projected inputs, (M, 2 H)
/// - `state`: hidden states before the first steps, (S, H)
/// - `saved`: overwritten, (M, 2 H)
/// - `outputs`: overwritten with the hidden states, (M, H)
pub fn forward(sequences: Sequences, inputs: &[f32], state: &[f32], saved: &mut [f32], outputs: &mut [f32]) {
    let Some(width) = state.len().checked_div(sequences.count()) else { return };
    for step in sequences.steps() {
        step.copy_states_before(state, outputs, saved, SAVED * width, width..2 * width);
        let rows = step.rows(inputs, 2 * width).zip(step.rows_mut(saved, SAVED * width));
        rows.zip(step.rows_mut(outputs, width)).for_each(|((input, saved), output)| unit_forward(input, saved, output));
    }
}

vectorised! {
/// One step of one sequence.
fn unit_forward(input: &[f32], saved: &mut [f32], output: &mut [f32]) {
    let width = output.len();
    let ([x_z, x_h], [z, before]) = (parts(input, width), parts_mut(saved, width));
    for i in 0..width {
        z[i] = sigmoid(x_z[i]);
        output[i] = z[i].mul_add(x_h[i] - before[i], before[i]);
    }
}
}

/// Computes the gradients of the inputs and of the states before the first steps.
///
/// With the gradient `g` of `h`, from this step's output and the step after:
///
/// ```text
/// dx_z = g (x_h - h') z (1 - z)       dx_h = g z       dh' = g (1 - z)
/// ```
///
/// # Arguments
///
/// - `inputs`: as in [`forward`]
/// - `saved`: what [`forward`] saved, (M, 2 H)
/// - `grad_outputs`: gradients of the outputs, (M, H)
/// - `grad_inputs`: overwritten with the gradients of the projected inputs, (M, 2 H)
/// - `grad_state`: overwritten with the gradients of the states before the first steps, (S, H)
pub fn backward(
    sequences: Sequences,
    inputs: &[f32],
    saved: &[f32],
    grad_outputs: &[f32],
    grad_inputs: &mut [f32],
    grad_state: &mut [f32],
) {
    let Some(width) = grad_state.len().checked_div(sequences.count()) else { return };
    grad_state.fill(0.0);
    for step in sequences.steps().rev() {
        let rows = step.rows(inputs, 2 * width).zip(step.rows(saved, SAVED * width));
        let rows = rows.zip(step.rows(grad_outputs, width)).zip(grad_state.chunks_exact_mut(width));
        for ((((input, saved), grad_output), carry), grad_input) in rows.zip(step.rows_mut(grad_inputs, 2 * width)) {
            unit_backward(input, saved, grad_output, carry, grad_input);
        }
        step.stop_at_resets(grad_state, width);
    }
}

vectorised! {
/// One step of one sequence. `carry` is the gradient of `h` from the step after, and then that of `h'`.
fn unit_backward(input: &[f32], saved: &[f32], grad_output: &[f32], carry: &mut [f32], grad_input: &mut [f32]) {
    let width = grad_output.len();
    let carry = &mut carry[..width];
    let ([_, x_h], [z, before]) = (parts::<2>(input, width), parts(saved, width));
    let [grad_z, grad_h] = parts_mut(grad_input, width);
    for i in 0..width {
        let g = grad_output[i] + carry[i];
        carry[i] = g * (1.0 - z[i]);
        grad_z[i] = g * (x_h[i] - before[i]) * z[i] * (1.0 - z[i]);
        grad_h[i] = g * z[i];
    }
}
}
