//! The network of the agent `gru` with feature observations, as `endless_gym_agents` computes it: a layer for the features, a layer
//! for the embedding, a GRU cell, the body, and the policy head. All numbers are float32.

use super::file::{AgentFileError, Tensors};

/// A fully connected layer.
#[derive(Debug)]
struct Layer {
    /// \[output\]\[input\].
    weight: Vec<f32>,
    bias: Vec<f32>,
    inputs: usize,
}

impl Layer {
    /// Takes `{name}.weight` and `{name}.bias`. A size of `None` allows any size.
    fn take(
        tensors: &mut Tensors,
        name: &str,
        inputs: Option<usize>,
        outputs: Option<usize>,
    ) -> Result<Self, AgentFileError> {
        let (outputs, bias) = tensors.take(&format!("{name}.bias"), &[outputs])?;
        let (inputs, weight) = tensors.take(&format!("{name}.weight"), &[Some(outputs), inputs])?;
        Ok(Layer { weight, bias, inputs })
    }

    fn outputs(&self) -> usize {
        self.bias.len()
    }

    fn apply(&self, x: &[f32]) -> Vec<f32> {
        let rows = self.weight.chunks_exact(self.inputs);
        rows.zip(&self.bias).map(|(row, bias)| row.iter().zip(x).map(|(w, x)| w * x).sum::<f32>() + bias).collect()
    }

    fn apply_relu(&self, x: &[f32]) -> Vec<f32> {
        let mut y = self.apply(x);
        y.iter_mut().for_each(|y| *y = y.max(0.0));
        y
    }
}

#[derive(Debug)]
pub struct Network {
    encoder: Layer,
    embedding: Layer,
    /// Layers from the input and from the hidden state to the gates: reset, update, new.
    input_gates: Layer,
    hidden_gates: Layer,
    body: Layer,
    policy: Layer,
    branches: Vec<Layer>,
}

impl Network {
    /// Takes the layers from a file's tensors.
    pub fn new(branches: &[usize], tensors: &mut Tensors) -> Result<Self, AgentFileError> {
        let encoder = Layer::take(tensors, "encoder.vector.0", None, None)?;
        let embedding = Layer::take(tensors, "memory.embedding.0", Some(encoder.outputs()), None)?;
        let hidden = embedding.outputs();
        let mut gates = |name: &str| -> Result<Layer, AgentFileError> {
            let weight = tensors.take(&format!("memory.recurrent.weight_{name}"), &[Some(3 * hidden), Some(hidden)])?.1;
            let bias = tensors.take(&format!("memory.recurrent.bias_{name}"), &[Some(3 * hidden)])?.1;
            Ok(Layer { weight, bias, inputs: hidden })
        };
        let (input_gates, hidden_gates) = (gates("ih_l0")?, gates("hh_l0")?);
        let body = Layer::take(tensors, "body.0", Some(hidden), None)?;
        let policy = Layer::take(tensors, "policy.hidden.0", Some(body.outputs()), None)?;
        let branch = |(number, choices): (usize, &usize)| {
            Layer::take(tensors, &format!("policy.branches.{number}"), Some(policy.outputs()), Some(*choices))
        };
        let branches = branches.iter().enumerate().map(branch).collect::<Result<_, _>>()?;
        Ok(Network { encoder, embedding, input_gates, hidden_gates, body, policy, branches })
    }

    /// Number of features.
    pub fn features(&self) -> usize {
        self.encoder.inputs
    }

    /// Size of the hidden state.
    pub fn hidden(&self) -> usize {
        self.hidden_gates.inputs
    }

    /// The logits of all branches in order; `hidden` becomes the next hidden state.
    pub fn step(&self, features: &[f32], hidden: &mut [f32]) -> Vec<f32> {
        let x = self.embedding.apply_relu(&self.encoder.apply_relu(features));
        let (input, before) = (self.input_gates.apply(&x), self.hidden_gates.apply(hidden));
        let size = hidden.len();
        for (i, hidden) in hidden.iter_mut().enumerate() {
            let reset = sigmoid(input[i] + before[i]);
            let update = sigmoid(input[size + i] + before[size + i]);
            let new = (input[2 * size + i] + reset * before[2 * size + i]).tanh();
            *hidden = (1.0 - update) * new + update * *hidden;
        }
        let y = self.policy.apply_relu(&self.body.apply_relu(hidden));
        self.branches.iter().flat_map(|branch| branch.apply(&y)).collect()
    }
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}
