//! Fully connected layers: `y = x W^T + b`, as `torch.nn.Linear`.
//!
//! Shapes: inputs x (M, I), weight W (O, I), bias b (O,), outputs y (M, O).

use crate::matrix::{Matrix, Packed, add_product, add_rows, product, product_plus_row};
use crate::vectors::vectorised;

/// Computes the outputs.
///
/// `weight` is packed from the transposed matrix: `packed.pack(Matrix::new(weight, I).t())`.
pub fn forward(x: &[f32], weight: &Packed, bias: &[f32], y: &mut [f32]) {
    product_plus_row(y, bias, Matrix::new(x, weight.rows()), weight);
}

/// Computes the gradient of the inputs, and adds those of weight and bias to `grad_weight` and `grad_bias`:
/// `dx = dy W`, `dW += dy^T x`, `db += sum of the rows of dy`. Where no gradient of the inputs is needed, `grad_x` is `None`.
pub fn backward(
    x: &[f32],
    weight: &[f32],
    grad_y: &[f32],
    grad_x: Option<&mut [f32]>,
    grad_weight: &mut [f32],
    grad_bias: &mut [f32],
    packed: &mut Packed,
) {
    let outputs = grad_bias.len();
    let (inputs, grad_y) = (grad_weight.len() / outputs, Matrix::new(grad_y, outputs));
    if let Some(grad_x) = grad_x {
        packed.pack(Matrix::new(weight, inputs));
        product(grad_x, grad_y, packed);
    }
    packed.pack(Matrix::new(x, inputs));
    add_product(grad_weight, grad_y.t(), packed);
    add_rows(grad_bias, grad_y.data());
}

vectorised! {
/// Replaces negative numbers by 0.
pub fn relu(y: &mut [f32]) {
    y.iter_mut().for_each(|y| *y = if *y < 0.0 { 0.0 } else { *y });
}
}

vectorised! {
/// Replaces the gradient of the outputs `y` of [`relu`] by that of its inputs: 0 where the output is 0.
pub fn relu_backward(y: &[f32], grad: &mut [f32]) {
    grad.iter_mut().zip(y).for_each(|(grad, y)| *grad = if *y <= 0.0 { 0.0 } else { *grad });
}
}
