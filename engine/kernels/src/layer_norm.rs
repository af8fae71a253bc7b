//! Layer normalisation (arXiv:1607.06450), as `torch.nn.LayerNorm` over the last dimension.
//!
//! For each row x (N,) of the inputs (M, N), with its mean m and its variance v = mean of (x - m)^2:
//!
//! ```text
//! s = 1 / sqrt(v + EPSILON)       u = (x - m) s       y = u w + b
//! ```

/// Added to the variance; PyTorch's default.
pub const EPSILON: f32 = 1e-5;

/// Computes the outputs `y` (M, N), and saves `u` (M, N) and `s` (M,) for [`backward`].
pub fn forward(x: &[f32], weight: &[f32], bias: &[f32], y: &mut [f32], u: &mut [f32], s: &mut [f32]) {
    let width = weight.len();
    let rows = x.chunks_exact(width).zip(y.chunks_exact_mut(width)).zip(u.chunks_exact_mut(width)).zip(s);
    for (((x, y), u), s) in rows {
        let mean = x.iter().sum::<f32>() / width as f32;
        let variance = x.iter().map(|x| (x - mean) * (x - mean)).sum::<f32>() / width as f32;
        *s = 1.0 / (variance + EPSILON).sqrt();
        for i in 0..width {
            u[i] = (x[i] - mean) * *s;
            y[i] = u[i].mul_add(weight[i], bias[i]);
        }
    }
}

/// Computes the gradient of the inputs, and adds those of weight and bias to `grad_weight` and `grad_bias`:
///
/// ```text
/// du = dy w       dx = s (du - mean(du) - u mean(du u))       dw += sum of dy u       db += sum of dy
/// ```
pub fn backward(
    weight: &[f32],
    u: &[f32],
    s: &[f32],
    grad_y: &[f32],
    grad_x: &mut [f32],
    grad_weight: &mut [f32],
    grad_bias: &mut [f32],
) {
    let width = weight.len();
    let rows = u.chunks_exact(width).zip(grad_y.chunks_exact(width)).zip(grad_x.chunks_exact_mut(width)).zip(s);
    for (((u, dy), dx), s) in rows {
        let (mut mean, mut mean_u) = (0.0, 0.0);
        for i in 0..width {
            grad_weight[i] += dy[i] * u[i];
            grad_bias[i] += dy[i];
            dx[i] = dy[i] * weight[i];
            mean += dx[i] / width as f32;
            mean_u += dx[i] * u[i] / width as f32;
        }
        for i in 0..width {
            dx[i] = s * (dx[i] - mean - u[i] * mean_u);
        }
    }
}
