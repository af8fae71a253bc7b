//! An actor-critic of encoder, memory, body and heads, forward and backward: the network of `endless_gym_agents` for vectors.
//!
//! ```text
//! observation -> encoder -> embedding -> memory -> body -> policy hidden -> logits
//!                                                       -> value hidden  -> value
//! ```
//!
//! Each arrow but those into the memory and the last ones ends with a ReLU. All parameters are one vector, so that the optimizer and
//! the sum of gradients are loops over it. Tensors have PyTorch's names and shapes, by which programs exchange weights.

use std::ops::Range;

use crate::linear::{self, relu, relu_backward};
use crate::matrix::{Matrix, Packed};
use crate::sequences::{Sequences, Workspace};
use crate::{gru, mingru};

/// Kinds and sizes of the layers.
#[derive(Clone, Debug)]
pub struct NetworkSpec {
    /// Numbers of an observation.
    pub observation_width: usize,
    /// Units of the encoder.
    pub encoder_width: usize,
    /// Whether a fully connected layer comes before the memory, with as many units as its hidden state.
    pub embedding: bool,
    /// Kind of the layers of the memory.
    pub memory: Memory,
    /// Number of layers of the memory; 0 for none.
    pub layers: usize,
    /// H, the size of the hidden state of each layer of the memory.
    pub hidden_size: usize,
    /// Whether the input of the memory is added to its output; both must have the same size.
    pub residual: bool,
    /// Units of the body.
    pub body_width: usize,
    /// Units of the hidden layer of each head.
    pub head_width: usize,
    /// Choices of each branch of the action.
    pub choices: Vec<usize>,
}

/// Kind of the layers of a memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Memory {
    /// Gated recurrent units.
    Gru,
    /// Gated recurrent units whose gates depend on the input only.
    MinGru,
}

/// A part of the parameters.
#[derive(Clone, Debug)]
pub struct Tensor {
    /// Name in PyTorch's `state_dict`.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Where it is among the parameters.
    pub range: Range<usize>,
}

/// The tensors, one after the other.
#[derive(Default)]
struct Tensors(Vec<Tensor>);

impl Tensors {
    fn length(&self) -> usize {
        self.0.last().map_or(0, |tensor| tensor.range.end)
    }

    fn add(&mut self, name: String, shape: &[usize]) {
        let range = self.length()..self.length() + shape.iter().product::<usize>();
        self.0.push(Tensor { name, shape: shape.to_vec(), range });
    }

    fn linear(&mut self, name: &str, inputs: usize, outputs: usize) -> Linear {
        self.named([(format!("{name}.weight"), format!("{name}.bias"), outputs)], inputs)
    }

    /// Fully connected layers with the same inputs as one, whose outputs are side by side: the names of weight and bias, and the
    /// outputs of each.
    fn named(&mut self, layers: impl IntoIterator<Item = (String, String, usize)>, inputs: usize) -> Linear {
        let (start, mut biases) = (self.length(), Vec::new());
        for (weight, bias, outputs) in layers {
            self.add(weight, &[outputs, inputs]);
            biases.push((bias, outputs));
        }
        let bias = self.length();
        biases.into_iter().for_each(|(name, outputs)| self.add(name, &[outputs]));
        Linear { weight: start..bias, bias: bias..self.length(), inputs, packed: Packed::default() }
    }

    /// A layer of the memory.
    fn layer(&mut self, memory: Memory, layer: usize, inputs: usize, hidden_size: usize) -> Recurrent {
        match memory {
            Memory::Gru => {
                let name = |kind: &str, part: &str| format!("memory.recurrent.{kind}_{part}_l{layer}");
                let mut part =
                    |part, inputs| self.named([(name("weight", part), name("bias", part), 3 * hidden_size)], inputs);
                Recurrent { inputs: part("ih", inputs), hidden: Some(part("hh", hidden_size)) }
            }
            Memory::MinGru => {
                let name = format!("memory.cell.layers.{layer}.projection");
                Recurrent { inputs: self.linear(&name, inputs, 2 * hidden_size), hidden: None }
            }
        }
    }
}

/// A fully connected layer: where its parameters are, and its weight in the order that products need.
struct Linear {
    weight: Range<usize>,
    bias: Range<usize>,
    inputs: usize,
    packed: Packed,
}

impl Linear {
    fn outputs(&self) -> usize {
        self.bias.len()
    }

    fn pack(&mut self, parameters: &[f32]) {
        self.packed.pack(Matrix::new(&parameters[self.weight.clone()], self.inputs).t());
    }

    fn forward(&self, parameters: &[f32], x: &[f32], y: &mut Vec<f32>) {
        y.resize(x.len() / self.inputs * self.outputs(), 0.0);
        linear::forward(x, &self.packed, &parameters[self.bias.clone()], y);
    }

    fn forward_relu(&self, parameters: &[f32], x: &[f32], y: &mut Vec<f32>) {
        self.forward(parameters, x, y);
        relu(y);
    }

    /// The gradients of weight and bias.
    fn gradients<'a>(&self, all: &'a mut [f32]) -> (&'a mut [f32], &'a mut [f32]) {
        all[self.weight.start..self.bias.end].split_at_mut(self.weight.len())
    }

    /// Adds the gradients of weight and bias to `all`, and computes that of the inputs `x`.
    fn backward(
        &self,
        parameters: &[f32],
        x: &[f32],
        grad_y: &[f32],
        grad_x: Option<&mut Vec<f32>>,
        all: &mut [f32],
        packed: &mut Packed,
    ) {
        let (grad_weight, grad_bias) = self.gradients(all);
        let grad_x = grad_x.map(|grad_x| {
            grad_x.resize(x.len(), 0.0);
            &mut grad_x[..]
        });
        linear::backward(x, &parameters[self.weight.clone()], grad_y, grad_x, grad_weight, grad_bias, packed);
    }
}

/// A layer of the memory: the projection of its inputs, and for a GRU that of the hidden state.
struct Recurrent {
    inputs: Linear,
    hidden: Option<Linear>,
}

/// The network.
pub struct Network {
    /// All parameters. After a change, [`pack`](Self::pack) them.
    pub parameters: Vec<f32>,
    /// The parts of the parameters.
    pub tensors: Vec<Tensor>,
    /// Kinds and sizes of the layers.
    pub spec: NetworkSpec,
    encoder: Linear,
    embedding: Option<Linear>,
    memory: Vec<Recurrent>,
    body: Linear,
    policy_hidden: Linear,
    policy: Linear,
    value_hidden: Linear,
    value: Linear,
}

/// The numbers of M steps of S sequences between forward and backward pass, with the memory that calls reuse.
#[derive(Default)]
pub struct Pass {
    /// Observations, (M, observation's width); set before [`Network::forward`].
    pub observations: Vec<f32>,
    /// Hidden states of each layer before the first steps, (S, H) each; set before [`Network::forward`].
    pub states: Vec<Vec<f32>>,
    /// Logits of all branches side by side, (M, choices).
    pub logits: Vec<f32>,
    /// Values, (M,).
    pub values: Vec<f32>,
    /// Gradients of the logits, (M, choices); set before [`Network::backward`].
    pub grad_logits: Vec<f32>,
    /// Gradients of the values, (M,); set before [`Network::backward`].
    pub grad_values: Vec<f32>,
    /// Gradients of all parameters.
    pub gradients: Vec<f32>,
    encoded: Vec<f32>,
    embedded: Vec<f32>,
    layers: Vec<LayerPass>,
    remembered: Vec<f32>,
    body: Vec<f32>,
    policy_hidden: Vec<f32>,
    value_hidden: Vec<f32>,
    /// Gradients of hidden layers, of one while another is computed.
    grads: [Vec<f32>; 3],
    packed: Packed,
    gru: Workspace,
}

#[derive(Default)]
struct LayerPass {
    inputs: Vec<f32>,
    saved: Vec<f32>,
    outputs: Vec<f32>,
    grad_state: Vec<f32>,
}

impl Pass {
    /// The hidden states of a layer after each step, (M, H).
    pub fn hidden(&self, layer: usize) -> &[f32] {
        &self.layers[layer].outputs
    }
}

impl Network {
    /// A network with the numbers that `weights` gives for each tensor, in the order of the parameters. Panics if
    /// `weights` gives a tensor another number of numbers.
    pub fn new<E>(spec: NetworkSpec, mut weights: impl FnMut(&Tensor) -> Result<Vec<f32>, E>) -> Result<Self, E> {
        let mut tensors = Tensors::default();
        let NetworkSpec { hidden_size, body_width, head_width, .. } = spec;
        let mut inputs = spec.encoder_width;
        let encoder = tensors.linear("encoder.vector.0", spec.observation_width, inputs);
        let embedding = spec.embedding.then(|| tensors.linear("memory.embedding.0", inputs, hidden_size));
        inputs = embedding.as_ref().map_or(inputs, Linear::outputs);
        let mut memory = Vec::new();
        for layer in 0..spec.layers {
            memory.push(tensors.layer(spec.memory, layer, inputs, hidden_size));
            inputs = hidden_size;
        }
        let body = tensors.linear("body.0", inputs, body_width);
        let policy_hidden = tensors.linear("policy.hidden.0", body_width, head_width);
        let branch = |i: usize, part: &str| format!("policy.branches.{i}.{part}");
        let branches = spec.choices.iter().enumerate();
        let branches = branches.map(|(i, choices)| (branch(i, "weight"), branch(i, "bias"), *choices));
        let policy = tensors.named(branches, head_width);
        let value_hidden = tensors.linear("value.layers.0", body_width, head_width);
        let value = tensors.linear("value.layers.2", head_width, 1);
        let mut parameters = Vec::new();
        for tensor in &tensors.0 {
            parameters.extend(weights(tensor)?);
            assert_eq!(parameters.len(), tensor.range.end, "{} must have the shape {:?}", tensor.name, tensor.shape);
        }
        let mut network = Network {
            parameters,
            tensors: tensors.0,
            spec,
            encoder,
            embedding,
            memory,
            body,
            policy_hidden,
            policy,
            value_hidden,
            value,
        };
        network.pack();
        Ok(network)
    }

    /// Prepares the parameters for [`forward`](Self::forward).
    pub fn pack(&mut self) {
        let Network {
            parameters, encoder, embedding, memory, body, policy_hidden, policy, value_hidden, value, ..
        } = self;
        let memory = memory.iter_mut().flat_map(|layer| std::iter::once(&mut layer.inputs).chain(&mut layer.hidden));
        let others = [encoder, body, policy_hidden, policy, value_hidden, value];
        others.into_iter().chain(embedding).chain(memory).for_each(|layer| layer.pack(parameters));
    }

    /// Computes logits, values and hidden states of all steps.
    pub fn forward(&self, sequences: Sequences, pass: &mut Pass) {
        self.encode(pass);
        let p = &self.parameters[..];
        let embedded = if self.embedding.is_some() { &pass.embedded } else { &pass.encoded };
        let (steps, hidden_size) = (sequences.rows(), self.spec.hidden_size);
        pass.layers.resize_with(self.memory.len(), LayerPass::default);
        for (i, layer) in self.memory.iter().enumerate() {
            let (before, rest) = pass.layers.split_at_mut(i);
            let now = &mut rest[0];
            layer.inputs.forward(p, before.last().map_or(embedded, |layer| &layer.outputs), &mut now.inputs);
            now.outputs.resize(steps * hidden_size, 0.0);
            let (inputs, state) = (&now.inputs, &pass.states[i]);
            if let Some(hidden) = &layer.hidden {
                now.saved.resize(steps * gru::SAVED * hidden_size, 0.0);
                let (bias, workspace) = (&p[hidden.bias.clone()], &mut pass.gru);
                let (saved, outputs) = (&mut now.saved, &mut now.outputs);
                gru::forward(sequences, inputs, &hidden.packed, bias, state, saved, outputs, workspace);
            } else {
                now.saved.resize(steps * mingru::SAVED * hidden_size, 0.0);
                mingru::forward(sequences, inputs, state, &mut now.saved, &mut now.outputs);
            }
        }
        pass.remembered.clone_from(pass.layers.last().map_or(embedded, |layer| &layer.outputs));
        if self.spec.residual {
            add(&mut pass.remembered, embedded);
        }
        self.decide(pass);
    }

    /// Computes logits and values with a memory of the caller's, for a network whose `spec.layers` is 0. `memory` gets the outputs of
    /// the layer before it, and returns as many numbers for the body.
    pub fn forward_with(&self, pass: &mut Pass, memory: impl FnOnce(&[f32]) -> Vec<f32>) {
        self.encode(pass);
        pass.remembered = memory(if self.embedding.is_some() { &pass.embedded } else { &pass.encoded });
        self.decide(pass);
    }

    /// The layers before the memory.
    fn encode(&self, pass: &mut Pass) {
        self.encoder.forward_relu(&self.parameters, &pass.observations, &mut pass.encoded);
        if let Some(embedding) = &self.embedding {
            embedding.forward_relu(&self.parameters, &pass.encoded, &mut pass.embedded);
        }
    }

    /// The layers after the memory.
    fn decide(&self, pass: &mut Pass) {
        let p = &self.parameters[..];
        self.body.forward_relu(p, &pass.remembered, &mut pass.body);
        self.policy_hidden.forward_relu(p, &pass.body, &mut pass.policy_hidden);
        self.policy.forward(p, &pass.policy_hidden, &mut pass.logits);
        self.value_hidden.forward_relu(p, &pass.body, &mut pass.value_hidden);
        self.value.forward(p, &pass.value_hidden, &mut pass.values);
    }

    /// Computes the gradients of all parameters, after [`forward`](Self::forward) with the same sequences.
    pub fn backward(&self, sequences: Sequences, pass: &mut Pass) {
        let Pass { gradients: all, packed, grads: [grad, other, last], layers, states, gru: workspace, .. } = pass;
        let p = &self.parameters[..];
        all.clear();
        all.resize(p.len(), 0.0);
        // Both heads, down to the body.
        self.policy.backward(p, &pass.policy_hidden, &pass.grad_logits, Some(other), all, packed);
        relu_backward(&pass.policy_hidden, other);
        self.policy_hidden.backward(p, &pass.body, other, Some(grad), all, packed);
        self.value.backward(p, &pass.value_hidden, &pass.grad_values, Some(last), all, packed);
        relu_backward(&pass.value_hidden, last);
        self.value_hidden.backward(p, &pass.body, last, Some(other), all, packed);
        add(grad, other);
        relu_backward(&pass.body, grad);
        self.body.backward(p, &pass.remembered, grad, Some(last), all, packed);
        // The memory, from `last` to `grad`.
        let embedded = if self.embedding.is_some() { &pass.embedded } else { &pass.encoded };
        grad.clone_from(last);
        for (i, layer) in self.memory.iter().enumerate().rev() {
            let (before, rest) = layers.split_at_mut(i);
            let now = &mut rest[0];
            now.grad_state.resize(states[i].len(), 0.0);
            other.resize(now.inputs.len(), 0.0);
            if let Some(hidden) = &layer.hidden {
                let (grad_weight, grad_bias) = hidden.gradients(all);
                let (weight, grad_state) = (&p[hidden.weight.clone()], &mut now.grad_state);
                gru::backward(
                    sequences,
                    weight,
                    &now.saved,
                    grad,
                    other,
                    grad_weight,
                    grad_bias,
                    grad_state,
                    workspace,
                );
            } else {
                mingru::backward(sequences, &now.inputs, &now.saved, grad, other, &mut now.grad_state);
            }
            let inputs = before.last().map_or(embedded, |layer| &layer.outputs);
            layer.inputs.backward(p, inputs, other, Some(grad), all, packed);
        }
        if self.spec.residual {
            add(grad, last);
        }
        if let Some(embedding) = &self.embedding {
            relu_backward(&pass.embedded, grad);
            embedding.backward(p, &pass.encoded, grad, Some(other), all, packed);
            std::mem::swap(grad, other);
        }
        relu_backward(&pass.encoded, grad);
        self.encoder.backward(p, &pass.observations, grad, None, all, packed);
    }
}

/// Adds `other` to `sum`.
pub fn add(sum: &mut [f32], other: &[f32]) {
    sum.iter_mut().zip(other).for_each(|(sum, x)| *sum += x);
}
