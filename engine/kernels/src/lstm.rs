//! Long short-term memory (Hochreiter and Schmidhuber, 1997; Gers et al., 2000), with the gates of `torch.nn.LSTM`.
//!
//! With the projected inputs `x = W_i input + b_i + b_h`, and the hidden state `h'` and the cell state `c'` before a step:
//!
//! ```text
//! i = sigmoid(x_i + W_i h')       input gate
//! f = sigmoid(x_f + W_f h')       forget gate
//! g = tanh(x_g + W_g h')          candidate
//! o = sigmoid(x_o + W_o h')       output gate
//! c = f c' + i g
//! h = o tanh(c)
//! ```
//!
//! Shapes: M steps of S [`Sequences`], H units; projected inputs (M, 4 H) and weight (4 H, H) in the order i, f, g, o. As in
//! [`gru`](crate::gru), only the products with `h'` are computed step by step.

use crate::functions::{sigmoid, tanh};
use crate::matrix::{Matrix, Packed, add_product};
use crate::sequences::{Sequences, Workspace, parts, parts_mut};
use crate::vectors::vectorised;

/// What [`forward`] saves for [`backward`] per step and unit: i, f, g, o, tanh(c), `c'` and `h'`.
pub const SAVED: usize = 7;

/// Computes the hidden states and the cell states after all steps.
///
/// # Arguments
///
/// - `inputs`: projected inputs, (M, 4 H)
/// - `weight`: recurrent weight, packed from the transposed matrix (H, 4 H)
/// - `hidden`, `cell`: states before the first steps, (S, H)
/// - `saved`: overwritten, (M, 7 H)
/// - `outputs`: overwritten with the hidden states, (M, H)
/// - `cells`: overwritten with the cell states, (M, H)
#[allow(clippy::too_many_arguments)]
pub fn forward(
    sequences: Sequences,
    inputs: &[f32],
    weight: &Packed,
    hidden: &[f32],
    cell: &[f32],
    saved: &mut [f32],
    outputs: &mut [f32],
    cells: &mut [f32],
    workspace: &mut Workspace,
) {
    let width = weight.rows();
    let gates = &mut workspace.rows;
    gates.resize(sequences.count() * 4 * width, 0.0);
    for step in sequences.steps() {
        step.copy_states_before(cell, cells, saved, SAVED * width, 5 * width..6 * width);
        step.copy_states_before(hidden, outputs, saved, SAVED * width, 6 * width..7 * width);
        let before = Matrix::new(step.of(saved, SAVED * width), SAVED * width).columns(6 * width..7 * width);
        gates.copy_from_slice(step.of(inputs, 4 * width));
        add_product(gates, before, weight);
        let rows = gates.chunks_exact(4 * width).zip(step.rows_mut(saved, SAVED * width));
        let rows = rows.zip(step.rows_mut(outputs, width)).zip(step.rows_mut(cells, width));
        rows.for_each(|(((gates, saved), output), cell)| unit_forward(gates, saved, output, cell));
    }
}

vectorised! {
/// One step of one sequence.
fn unit_forward(gates: &[f32], saved: &mut [f32], output: &mut [f32], cell: &mut [f32]) {
    let width = output.len();
    let cell = &mut cell[..width];
    let [x_i, x_f, x_g, x_o] = parts(gates, width);
    let [i, f, g, o, squashed, before, _] = parts_mut(saved, width);
    // Loops over few arrays: see the GRU.
    for j in 0..width {
        i[j] = sigmoid(x_i[j]);
        f[j] = sigmoid(x_f[j]);
    }
    for j in 0..width {
        g[j] = tanh(x_g[j]);
        o[j] = sigmoid(x_o[j]);
    }
    for j in 0..width {
        cell[j] = f[j].mul_add(before[j], i[j] * g[j]);
    }
    for j in 0..width {
        squashed[j] = tanh(cell[j]);
        output[j] = o[j] * squashed[j];
    }
}
}

/// Computes the gradients of the inputs and of the states before the first steps, and adds that of the weight to `grad_weight`.
///
/// With the gradient `a` of `h`, from this step's output and the step after, and `b` of `c`, from the step after:
///
/// ```text
/// dc = b + a o (1 - tanh(c)^2)        dx_o = a tanh(c) o (1 - o)
/// dx_i = dc g i (1 - i)       dx_f = dc c' f (1 - f)       dx_g = dc i (1 - g^2)
/// dc' = dc f       dh' = W^T dx       dW += dx h'^T
/// ```
///
/// # Arguments
///
/// - `weight`: recurrent weight, (4 H, H)
/// - `saved`: what [`forward`] saved, (M, 7 H)
/// - `grad_outputs`: gradients of the outputs, (M, H)
/// - `grad_inputs`: overwritten with the gradients of the projected inputs, (M, 4 H)
/// - `grad_hidden`, `grad_cell`: overwritten with the gradients of the states before the first steps, (S, H)
#[allow(clippy::too_many_arguments)]
pub fn backward(
    sequences: Sequences,
    weight: &[f32],
    saved: &[f32],
    grad_outputs: &[f32],
    grad_inputs: &mut [f32],
    grad_weight: &mut [f32],
    grad_hidden: &mut [f32],
    grad_cell: &mut [f32],
    workspace: &mut Workspace,
) {
    let Some(width) = grad_hidden.len().checked_div(sequences.count()) else { return };
    let packed = &mut workspace.packed;
    packed.pack(Matrix::new(weight, width));
    grad_hidden.fill(0.0);
    grad_cell.fill(0.0);
    for step in sequences.steps().rev() {
        let rows = step.rows(saved, SAVED * width).zip(step.rows(grad_outputs, width));
        let rows = rows.zip(grad_hidden.chunks_exact_mut(width)).zip(grad_cell.chunks_exact_mut(width));
        for ((((saved, grad_output), carry), carry_cell), grad_input) in rows.zip(step.rows_mut(grad_inputs, 4 * width))
        {
            unit_backward(saved, grad_output, carry, carry_cell, grad_input);
        }
        add_product(grad_hidden, Matrix::new(step.of(grad_inputs, 4 * width), 4 * width), packed);
        step.stop_at_resets(grad_hidden, width);
        step.stop_at_resets(grad_cell, width);
    }
    packed.pack(Matrix::new(saved, SAVED * width).columns(6 * width..7 * width));
    add_product(grad_weight, Matrix::new(grad_inputs, 4 * width).t(), packed);
}

vectorised! {
/// One step of one sequence. `carry` and `carry_cell` are the gradients of `h` and `c` from the step after, and then 0 and `dc f`;
/// in between, `carry_cell` is `dc`.
fn unit_backward(
    saved: &[f32],
    grad_output: &[f32],
    carry: &mut [f32],
    carry_cell: &mut [f32],
    grad_input: &mut [f32],
) {
    let width = grad_output.len();
    let (carry, carry_cell) = (&mut carry[..width], &mut carry_cell[..width]);
    let [i, f, g, o, squashed, before, _] = parts(saved, width);
    let [x_i, x_f, x_g, x_o] = parts_mut(grad_input, width);
    for j in 0..width {
        let a = grad_output[j] + carry[j];
        carry[j] = 0.0;
        carry_cell[j] += a * o[j] * (1.0 - squashed[j] * squashed[j]);
        x_o[j] = a * squashed[j] * o[j] * (1.0 - o[j]);
    }
    for j in 0..width {
        x_i[j] = carry_cell[j] * g[j] * i[j] * (1.0 - i[j]);
        x_g[j] = carry_cell[j] * i[j] * (1.0 - g[j] * g[j]);
    }
    for j in 0..width {
        x_f[j] = carry_cell[j] * before[j] * f[j] * (1.0 - f[j]);
        carry_cell[j] *= f[j];
    }
}
}
