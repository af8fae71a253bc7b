//! Acting steps of the memories Gated DeltaNet, Mamba-2 and RetNet, whose equations are in `endless_gym_agents.memories`.
//!
//! The state of a head is a matrix S (K, V). A step with query q, key k, value v and decay a computes
//!
//! ```text
//! S = a S + k u^T,   y = S^T q        with u = v, or for the gated delta rule with rate b: u = b (v - a S^T k)
//! ```

use endless_gym_kernels::functions::sigmoid;

/// Steps of a convolution.
const WINDOW: usize = 4;

/// Kind of the layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    GatedDeltaNet,
    Mamba2,
    RetNet,
}

/// Sizes of the layers.
#[derive(Clone, Copy, Debug)]
pub struct Sizes {
    /// Size of the inputs and outputs.
    pub width: usize,
    /// Number of heads.
    pub heads: usize,
    /// Size of the values of all heads, heads * V.
    pub inner: usize,
    /// K, the size of a key.
    pub keys: usize,
    /// Size of the feed-forward network; 0 if there is none.
    pub feed_forward: usize,
}

/// Residual layers x + layer(norm(x)), each followed by y + feed_forward(norm(y)), and a last normalisation.
pub struct Stack {
    kind: Kind,
    sizes: Sizes,
    layers: Vec<Layer>,
    norm: Vec<f32>,
}

/// Weights of a layer, with the names of the Python class. Those that a kind does not have are empty.
struct Layer {
    norm: Vec<f32>,
    enter: Vec<f32>,
    convolution: Vec<f32>,
    convolution_bias: Vec<f32>,
    a_log: Vec<f32>,
    dt_bias: Vec<f32>,
    d: Vec<f32>,
    gamma: Vec<f32>,
    inner_norm: Vec<f32>,
    leave: Vec<f32>,
    feed_forward: [Vec<f32>; 3],
}

/// State of a layer.
#[derive(Clone, Default)]
pub struct State {
    /// S of all heads.
    s: Vec<f32>,
    /// The last inputs of the convolution, oldest first.
    window: Vec<f32>,
    /// Steps of the episode.
    steps: f32,
}

impl Stack {
    /// Layers with the numbers that `weights` gives for the name and the shape of each tensor.
    ///
    /// # Errors
    ///
    /// Those of `weights`.
    pub fn new<E>(
        kind: Kind,
        layers: usize,
        sizes: Sizes,
        mut weights: impl FnMut(String, &[usize]) -> Result<Vec<f32>, E>,
    ) -> Result<Self, E> {
        let Sizes { width, heads, inner, keys, feed_forward } = sizes;
        let convolved = match kind {
            Kind::GatedDeltaNet | Kind::RetNet => 2 * heads * keys + inner,
            Kind::Mamba2 => inner + 2 * keys,
        };
        let numbers = match kind {
            Kind::GatedDeltaNet => 2 * heads,
            Kind::Mamba2 => heads,
            Kind::RetNet => 0,
        };
        let (retnet, mamba) = (kind == Kind::RetNet, kind == Kind::Mamba2);
        let normalised = if mamba { inner } else { inner / heads };
        let layer = |i: usize| {
            let mut tensor = |exists: bool, name: &str, shape: &[usize]| {
                if exists { weights(format!("memory.cell.{name}"), shape) } else { Ok(Vec::new()) }
            };
            let of = |name: &str| format!("layers.{i}.{name}");
            Ok(Layer {
                norm: tensor(true, &format!("norms.{i}.weight"), &[width])?,
                enter: tensor(true, &of("enter.weight"), &[convolved + inner + numbers, width])?,
                convolution: tensor(!retnet, &of("convolution.weight"), &[WINDOW, convolved])?,
                convolution_bias: tensor(mamba, &of("convolution.bias"), &[convolved])?,
                a_log: tensor(!retnet, &of("a_log"), &[heads])?,
                dt_bias: tensor(!retnet, &of("dt_bias"), &[heads])?,
                d: tensor(mamba, &of("d"), &[heads])?,
                gamma: tensor(retnet, &of("gamma"), &[heads])?,
                inner_norm: if retnet {
                    vec![1.0; normalised]
                } else {
                    tensor(true, &of("norm.weight"), &[normalised])?
                },
                leave: tensor(true, &of("leave.weight"), &[width, inner])?,
                feed_forward: [
                    tensor(feed_forward > 0, &of("feed_forward.norm.weight"), &[width])?,
                    tensor(feed_forward > 0, &of("feed_forward.enter.weight"), &[2 * feed_forward, width])?,
                    tensor(feed_forward > 0, &of("feed_forward.leave.weight"), &[width, feed_forward])?,
                ],
            })
        };
        let layers = (0..layers).map(layer).collect::<Result<Vec<_>, E>>()?;
        let norm = weights(format!("memory.cell.norms.{}.weight", layers.len()), &[width])?;
        Ok(Stack { kind, sizes, layers, norm })
    }

    /// The states at the start of an episode.
    pub fn start(&self) -> Vec<State> {
        let Sizes { inner, keys, .. } = self.sizes;
        let state = |layer: &Layer| State {
            s: vec![0.0; keys * inner],
            window: vec![0.0; layer.convolution.len() / WINDOW * (WINDOW - 1)],
            steps: 0.0,
        };
        self.layers.iter().map(state).collect()
    }

    /// The outputs of a step, and the states after it.
    pub fn step(&self, x: &[f32], states: &mut [State]) -> Vec<f32> {
        let mut x = x.to_vec();
        for (layer, state) in self.layers.iter().zip(states) {
            let y = self.layer(layer, &self.normalised(&x, &layer.norm), state);
            x.iter_mut().zip(y).for_each(|(x, y)| *x += y);
            if self.sizes.feed_forward > 0 {
                let y = self.feed_forward(layer, &x);
                x.iter_mut().zip(y).for_each(|(x, y)| *x += y);
            }
        }
        self.normalised(&x, &self.norm)
    }

    /// The outputs of a layer's feed-forward network.
    fn feed_forward(&self, layer: &Layer, x: &[f32]) -> Vec<f32> {
        let [norm, enter, leave] = &layer.feed_forward;
        let activation = if self.kind == Kind::RetNet { gelu } else { silu };
        let entered = product(enter, &self.normalised(x, norm));
        let (one, other) = entered.split_at(self.sizes.feed_forward);
        let gated: Vec<f32> = one.iter().zip(other).map(|(one, other)| activation(*one) * other).collect();
        product(leave, &gated)
    }

    /// RMSNorm (arXiv:1910.07467): x / sqrt(mean(x^2) + epsilon) * weight.
    fn normalised(&self, x: &[f32], weight: &[f32]) -> Vec<f32> {
        let epsilon = if self.kind == Kind::RetNet { 1e-6 } else { 1e-5 };
        let mean = x.iter().map(|x| x * x).sum::<f32>() / x.len() as f32;
        let scale = 1.0 / (mean + epsilon).sqrt();
        x.iter().zip(weight).map(|(x, weight)| x * scale * weight).collect()
    }

    /// The outputs of a layer for its normalised inputs, and its state after the step.
    fn layer(&self, layer: &Layer, x: &[f32], state: &mut State) -> Vec<f32> {
        let Sizes { heads, inner, keys, .. } = self.sizes;
        let entered = product(&layer.enter, x);
        // Where the output gate is in `entered`; queries, keys and values of all heads; where the inputs of decays and rates are.
        let (gate, mut q, mut k, mut v, numbers) = match self.kind {
            Kind::GatedDeltaNet => {
                let gate = 2 * heads * keys + inner;
                let convolved = convolution(layer, &entered[..gate], &mut state.window);
                let (qk, v) = convolved.split_at(gate - inner);
                let (q, k) = qk.split_at(heads * keys);
                (gate..gate + inner, q.to_vec(), k.to_vec(), v.to_vec(), gate + inner..entered.len())
            }
            Kind::Mamba2 => {
                let convolved = convolution(layer, &entered[inner..entered.len() - heads], &mut state.window);
                let (v, rest) = convolved.split_at(inner);
                let (k, q) = rest.split_at(keys);
                (0..inner, q.repeat(heads), k.repeat(heads), v.to_vec(), entered.len() - heads..entered.len())
            }
            Kind::RetNet => {
                let (qk, vg) = entered.split_at(2 * heads * keys);
                let (q, k) = qk.split_at(heads * keys);
                (qk.len() + inner..entered.len(), q.to_vec(), k.to_vec(), vg[..inner].to_vec(), 0..0)
            }
        };
        let mut y = vec![0.0; inner];
        for head in 0..heads {
            let part = |size: usize| head * size..(head + 1) * size;
            let (q, k) = (&mut q[part(keys)], &mut k[part(keys)]);
            let (v, y) = (&mut v[part(inner / heads)], &mut y[part(inner / heads)]);
            let s = &mut state.s[part(keys * inner / heads)];
            let scale = (keys as f32).powf(-0.5);
            match self.kind {
                Kind::GatedDeltaNet => {
                    [&mut *q, &mut *k].into_iter().for_each(unit);
                    q.iter_mut().for_each(|q| *q *= scale);
                    let [a, b] = [0, heads].map(|offset| entered[numbers.start + offset + head]);
                    let decay = (-layer.a_log[head].exp() * softplus(a + layer.dt_bias[head])).exp();
                    attend(s, q, k, v, decay, Some(sigmoid(b)), y);
                }
                Kind::Mamba2 => {
                    let dt = softplus(entered[numbers.start + head] + layer.dt_bias[head]);
                    let direct: Vec<f32> = v.iter().map(|x| layer.d[head] * x).collect();
                    v.iter_mut().for_each(|x| *x *= dt);
                    attend(s, q, k, v, (-dt * layer.a_log[head].exp()).exp(), None, y);
                    y.iter_mut().zip(direct).for_each(|(y, direct)| *y += direct);
                }
                Kind::RetNet => {
                    let gamma = layer.gamma[head];
                    k.iter_mut().for_each(|k| *k *= scale);
                    [&mut *q, &mut *k].into_iter().for_each(|x| rotate(x, state.steps));
                    attend(s, q, k, v, gamma, None, y);
                    let powers = (1.0 - gamma.powf(state.steps + 1.0)) / (1.0 - gamma);
                    y.iter_mut().for_each(|y| *y /= powers.sqrt());
                }
            }
        }
        state.steps += 1.0;
        let gate = entered[gate].iter().map(|x| silu(*x));
        if self.kind == Kind::Mamba2 {
            y.iter_mut().zip(gate).for_each(|(y, gate)| *y *= gate);
            y = self.normalised(&y, &layer.inner_norm);
        } else {
            y = y.chunks(inner / heads).flat_map(|y| self.normalised(y, &layer.inner_norm)).collect();
            y.iter_mut().zip(gate).for_each(|(y, gate)| *y *= gate);
        }
        product(&layer.leave, &y)
    }
}

/// The step of a head, from its state `s` (K, V) before to that after it.
fn attend(s: &mut [f32], q: &[f32], k: &[f32], v: &[f32], decay: f32, rate: Option<f32>, y: &mut [f32]) {
    s.iter_mut().for_each(|s| *s *= decay);
    let read = |s: &[f32], by: &[f32], j: usize| -> f32 {
        by.iter().zip(s.chunks(v.len())).map(|(by, row)| by * row[j]).sum()
    };
    let stored: Vec<f32> = (0..v.len()).map(|j| rate.map_or(v[j], |rate| rate * (v[j] - read(s, k, j)))).collect();
    for (k, row) in k.iter().zip(s.chunks_mut(stored.len())) {
        row.iter_mut().zip(&stored).for_each(|(s, u)| *s += k * u);
    }
    y.iter_mut().enumerate().for_each(|(j, y)| *y = read(s, q, j));
}

/// y_t = silu(bias + sum over j of w_j x_{t - j}), and the window after the step.
fn convolution(layer: &Layer, x: &[f32], window: &mut Vec<f32>) -> Vec<f32> {
    window.extend_from_slice(x);
    let y = (0..x.len()).map(|channel| {
        let past = (0..WINDOW)
            .map(|j| layer.convolution[j * x.len() + channel] * window[(WINDOW - 1 - j) * x.len() + channel]);
        silu(layer.convolution_bias.get(channel).unwrap_or(&0.0) + past.sum::<f32>())
    });
    let y = y.collect();
    window.drain(..x.len());
    y
}

/// W x of the rows of W.
fn product(weight: &[f32], x: &[f32]) -> Vec<f32> {
    weight.chunks(x.len()).map(|row| row.iter().zip(x).map(|(w, x)| w * x).sum()).collect()
}

/// Divides by the length.
fn unit(x: &mut [f32]) {
    let length = (x.iter().map(|x| x * x).sum::<f32>() + 1e-6).sqrt();
    x.iter_mut().for_each(|x| *x /= length);
}

/// Rotates the pairs of entries i and i + n by n angles, `step` times 1 to 10^-4.
fn rotate(x: &mut [f32], step: f32) {
    let half = x.len() / 2;
    for i in 0..half {
        let part = i as f32 / (half - 1).max(1) as f32;
        let (sine, cosine) = (step * 10_000_f32.powf(-part)).sin_cos();
        (x[i], x[half + i]) = (x[i] * cosine - x[half + i] * sine, x[half + i] * cosine + x[i] * sine);
    }
}

fn silu(x: f32) -> f32 {
    x * sigmoid(x)
}

fn gelu(x: f32) -> f32 {
    0.5 * x * (1.0 + libm::erff(x * std::f32::consts::FRAC_1_SQRT_2))
}

/// log(1 + exp(x)).
fn softplus(x: f32) -> f32 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}
