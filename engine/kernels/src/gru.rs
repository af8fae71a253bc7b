//! Gated recurrent units (Cho et al., 2014), with the gates of `torch.nn.GRU`.
//!
//! With the projected inputs `x = W_i input + b_i` and the state `h'` before a step:
//!
//! ```text
//! r = sigmoid(x_r + W_r h' + b_r)           reset gate
//! z = sigmoid(x_z + W_z h' + b_z)           update gate
//! p = W_n h' + b_n
//! n = tanh(x_n + r p)                       candidate
//! h = (1 - z) n + z h'
//! ```
//!
//! Shapes: M steps of S [`Sequences`], H units; projected inputs (M, 3 H) and weight (3 H, H) and bias (3 H,) in the order r, z, n. The
//! inputs of all steps are projected at once by [`linear`](crate::linear), and the gradient of the weight is one product over all
//! steps (Appleyard et al., "Optimizing performance of recurrent neural networks on GPUs", 2016). Only the products with `h'` are
//! computed step by step.

use crate::functions::{sigmoid, tanh};
use crate::matrix::{Matrix, Packed, add_product, add_rows, product_plus_row};
use crate::sequences::{Sequences, Workspace, parts, parts_mut};
use crate::vectors::vectorised;

/// What [`forward`] saves for [`backward`] per step and unit: r, z, n, p and `h'`.
pub const SAVED: usize = 5;

/// Computes the hidden states after all steps.
///
/// # Arguments
///
/// - `inputs`: projected inputs, (M, 3 H)
/// - `weight`: recurrent weight, packed from the transposed matrix (H, 3 H)
/// - `bias`: recurrent bias, (3 H,)
/// - `state`: hidden states before the first steps, (S, H)
/// - `saved`: overwritten, (M, 5 H)
/// - `outputs`: overwritten with the hidden states, (M, H)
#[allow(clippy::too_many_arguments)]
pub fn forward(
    sequences: Sequences,
    inputs: &[f32],
    weight: &Packed,
    bias: &[f32],
    state: &[f32],
    saved: &mut [f32],
    outputs: &mut [f32],
    workspace: &mut Workspace,
) {
    let width = bias.len() / 3;
    let recurrent = &mut workspace.rows;
    recurrent.resize(sequences.count() * 3 * width, 0.0);
    for step in sequences.steps() {
        step.copy_states_before(state, outputs, saved, SAVED * width, 4 * width..5 * width);
        let before = Matrix::new(step.of(saved, SAVED * width), SAVED * width).columns(4 * width..5 * width);
        product_plus_row(recurrent, bias, before, weight);
        let rows = step.rows(inputs, 3 * width).zip(recurrent.chunks_exact(3 * width));
        let rows = rows.zip(step.rows_mut(saved, SAVED * width)).zip(step.rows_mut(outputs, width));
        rows.for_each(|(((input, recurrent), saved), output)| unit_forward(input, recurrent, saved, output));
    }
}

vectorised! {
/// One step of one sequence.
fn unit_forward(input: &[f32], recurrent: &[f32], saved: &mut [f32], output: &mut [f32]) {
    let width = output.len();
    // Loops over few arrays, which the compiler proves or checks to be apart, and turns into vector instructions.
    for i in 0..2 * width {
        saved[i] = sigmoid(input[i] + recurrent[i]);
    }
    let [r, z, n, p, before] = parts_mut(saved, width);
    let ([_, _, x_n], [_, _, w_n]) = (parts(input, width), parts(recurrent, width));
    p.copy_from_slice(w_n);
    for i in 0..width {
        n[i] = tanh(r[i].mul_add(w_n[i], x_n[i]));
    }
    for i in 0..width {
        output[i] = z[i].mul_add(before[i] - n[i], n[i]);
    }
}
}

/// Computes the gradients of the inputs and of the states before the first steps, and adds those of weight and bias to
/// `grad_weight` and `grad_bias`.
///
/// With the gradient `g` of `h`, from this step's output and the step after:
///
/// ```text
/// dx_n = g (1 - z) (1 - n^2)       dx_r = dx_n p r (1 - r)       dx_z = g (h' - n) z (1 - z)
/// d = (dx_r, dx_z, dx_n r)         dh' = g z + W^T d             dW += d h'^T        db += d
/// ```
///
/// # Arguments
///
/// - `weight`: recurrent weight, (3 H, H)
/// - `saved`: what [`forward`] saved, (M, 5 H)
/// - `grad_outputs`: gradients of the outputs, (M, H)
/// - `grad_inputs`: overwritten with the gradients of the projected inputs, (M, 3 H)
/// - `grad_state`: overwritten with the gradients of the states before the first steps, (S, H)
#[allow(clippy::too_many_arguments)]
pub fn backward(
    sequences: Sequences,
    weight: &[f32],
    saved: &[f32],
    grad_outputs: &[f32],
    grad_inputs: &mut [f32],
    grad_weight: &mut [f32],
    grad_bias: &mut [f32],
    grad_state: &mut [f32],
    workspace: &mut Workspace,
) {
    let width = grad_bias.len() / 3;
    let Workspace { packed, rows: deltas } = workspace;
    packed.pack(Matrix::new(weight, width));
    deltas.resize(sequences.rows() * 3 * width, 0.0);
    grad_state.fill(0.0);
    for step in sequences.steps().rev() {
        let rows = step.rows(saved, SAVED * width).zip(step.rows(grad_outputs, width));
        let rows = rows.zip(grad_state.chunks_exact_mut(width)).zip(step.rows_mut(grad_inputs, 3 * width));
        for ((((saved, grad_output), carry), grad_input), delta) in rows.zip(step.rows_mut(deltas, 3 * width)) {
            unit_backward(saved, grad_output, carry, grad_input, delta);
        }
        add_product(grad_state, Matrix::new(step.of(deltas, 3 * width), 3 * width), packed);
        step.stop_at_resets(grad_state, width);
    }
    packed.pack(Matrix::new(saved, SAVED * width).columns(4 * width..5 * width));
    add_product(grad_weight, Matrix::new(deltas, 3 * width).t(), packed);
    add_rows(grad_bias, deltas);
}

vectorised! {
/// One step of one sequence. `carry` is the gradient of `h` from the step after, then `g`, and then `g z`.
fn unit_backward(saved: &[f32], grad_output: &[f32], carry: &mut [f32], grad_input: &mut [f32], delta: &mut [f32]) {
    let width = grad_output.len();
    let carry = &mut carry[..width];
    let [r, z, n, p, before] = parts(saved, width);
    let [x_r, x_z, x_n] = parts_mut(grad_input, width);
    for i in 0..width {
        carry[i] += grad_output[i];
        x_n[i] = carry[i] * (1.0 - z[i]) * (1.0 - n[i] * n[i]);
    }
    for i in 0..width {
        x_r[i] = x_n[i] * p[i] * r[i] * (1.0 - r[i]);
    }
    for i in 0..width {
        x_z[i] = carry[i] * (before[i] - n[i]) * z[i] * (1.0 - z[i]);
        carry[i] *= z[i];
    }
    let (gates, candidate) = delta.split_at_mut(2 * width);
    for i in 0..width {
        candidate[i] = x_n[i] * r[i];
    }
    gates.copy_from_slice(&grad_input[..2 * width]);
}
}
