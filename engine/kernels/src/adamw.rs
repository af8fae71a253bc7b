//! AdamW (Loshchilov and Hutter, 2019), as `torch.optim.AdamW`, and clipping of the global norm.

use crate::vectors::vectorised;

/// The optimizer of one vector of parameters.
///
/// At update t, with the gradient g, the learning rate a, and all other coefficients as in PyTorch by default:
///
/// ```text
/// m = 0.9 m + 0.1 g       v = 0.999 v + 0.001 g^2       w = w - 0.01 a w
/// w = w - a m / (1 - 0.9^t) / (sqrt(v / (1 - 0.999^t)) + 1e-8)
/// ```
#[derive(Clone)]
pub struct AdamW {
    mean: Vec<f32>,
    square: Vec<f32>,
    updates: i32,
}

impl AdamW {
    const BETA: (f64, f64) = (0.9, 0.999);
    const EPSILON: f32 = 1e-8;
    const WEIGHT_DECAY: f64 = 0.01;

    /// The optimizer of so many parameters before the first update.
    pub fn new(parameters: usize) -> Self {
        AdamW { mean: vec![0.0; parameters], square: vec![0.0; parameters], updates: 0 }
    }

    /// The state, for [`from_state`](Self::from_state): m, v, and the number of updates t.
    pub fn state(&self) -> (&[f32], &[f32], i32) {
        (&self.mean, &self.square, self.updates)
    }

    /// The optimizer in a state that [`state`](Self::state) returned. Panics if the lengths of m and v differ.
    pub fn from_state(mean: Vec<f32>, square: Vec<f32>, updates: i32) -> Self {
        assert_eq!(mean.len(), square.len());
        AdamW { mean, square, updates }
    }

    /// Updates the parameters. Panics if the lengths differ from that in [`new`](Self::new).
    pub fn update(&mut self, parameters: &mut [f32], gradients: &[f32], learning_rate: f64) {
        assert_eq!((parameters.len(), gradients.len()), (self.mean.len(), self.mean.len()));
        self.updates += 1;
        let decay = (1.0 - learning_rate * Self::WEIGHT_DECAY) as f32;
        let step = (learning_rate / (1.0 - Self::BETA.0.powi(self.updates))) as f32;
        let root = (1.0 - Self::BETA.1.powi(self.updates)).sqrt() as f32;
        update(parameters, gradients, &mut self.mean, &mut self.square, decay, step, root);
    }
}

vectorised! {
/// The loop of [`AdamW::update`]; `root` is the square root of `1 - 0.999^t`.
fn update(w: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32], decay: f32, step: f32, root: f32) {
    let (new_mean, new_square) = ((1.0 - AdamW::BETA.0) as f32, (1.0 - AdamW::BETA.1) as f32);
    for (((w, g), m), v) in w.iter_mut().zip(g).zip(m).zip(v) {
        *m += new_mean * (g - *m);
        *v = AdamW::BETA.1 as f32 * *v + new_square * g * g;
        *w = *w * decay - step * *m / (v.sqrt() / root + AdamW::EPSILON);
    }
}
}

/// Scales gradients so that their Euclidean norm is at most `limit`, as `torch.nn.utils.clip_grad_norm_`. Returns the norm before.
pub fn clip_norm(gradients: &mut [f32], limit: f32) -> f32 {
    let norm = gradients.iter().map(|g| f64::from(*g) * f64::from(*g)).sum::<f64>().sqrt() as f32;
    // NaN if the norm is NaN, as in PyTorch.
    let scale = (limit / (norm + 1e-6)).clamp(0.0, 1.0);
    gradients.iter_mut().for_each(|g| *g *= scale);
    norm
}
