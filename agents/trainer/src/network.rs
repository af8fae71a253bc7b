//! The network: an actor-critic of encoder, memory, body and heads, as the Python agents' `agent.py`.
//!
//! ```text
//! observation -> encoder -> embedding -> memory -> body -> policy hidden -> logits
//!                                                       -> value hidden  -> value
//! ```
//!
//! Each arrow but those into the memory and the last ones ends with a ReLU. All parameters are one vector, so that the optimizer and
//! the sum of gradients are loops over it. Tensors have PyTorch's names and shapes, by which both programs exchange weights.

use std::ops::Range;

use endless_gym_core::random::Generator;
use endless_gym_kernels::linear::{self, relu, relu_backward};
use endless_gym_kernels::matrix::{Matrix, Packed};
use endless_gym_kernels::orthogonal::orthogonal;
use endless_gym_kernels::sequences::Sequences;
use endless_gym_kernels::{gru, mingru};

use crate::settings::{Agent, Settings};

/// A part of the parameters.
#[derive(Clone, Debug)]
pub struct Tensor {
    /// Name in PyTorch's `state_dict`.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Where it is among the parameters.
    pub range: Range<usize>,
    initial: Initial,
}

/// Initial numbers of a tensor.
#[derive(Clone, Copy, Debug)]
enum Initial {
    /// So many orthogonal matrices above each other, times a gain.
    Orthogonal(usize, f32),
    /// Uniform between this number and its negative.
    Uniform(f32),
    Zero,
}

/// The tensors, one after the other.
#[derive(Default)]
struct Tensors {
    tensors: Vec<Tensor>,
    length: usize,
}

impl Tensors {
    fn add(&mut self, name: String, shape: &[usize], initial: Initial) {
        let range = self.length..self.length + shape.iter().product::<usize>();
        self.length = range.end;
        self.tensors.push(Tensor { name, shape: shape.to_vec(), range, initial });
    }

    /// A fully connected layer with orthogonal weights, and biases as PyTorch's `nn.Linear`.
    fn linear(&mut self, name: &str, inputs: usize, outputs: usize, gain: f32) -> Linear {
        self.branches(&[(name.to_owned(), outputs)], inputs, gain)
    }

    /// Several fully connected layers with the same inputs as one, whose outputs are side by side.
    fn branches(&mut self, branches: &[(String, usize)], inputs: usize, gain: f32) -> Linear {
        let start = self.length;
        for (name, outputs) in branches {
            self.add(format!("{name}.weight"), &[*outputs, inputs], Initial::Orthogonal(1, gain));
        }
        let bias = self.length;
        for (name, outputs) in branches {
            self.add(format!("{name}.bias"), &[*outputs], Initial::Uniform(1.0 / (inputs as f32).sqrt()));
        }
        Linear::new(start, bias, self.length, inputs)
    }

    /// A weight and a bias of a recurrent layer.
    fn recurrent(&mut self, names: [String; 2], inputs: usize, outputs: usize, initial: Initial) -> Linear {
        let [weight, bias] = names.map(|name| format!("memory.{name}"));
        let start = self.length;
        self.add(weight, &[outputs, inputs], initial);
        let end = self.length;
        self.add(bias, &[outputs], Initial::Zero);
        Linear::new(start, end, self.length, inputs)
    }

    /// A layer of the memory, with the names and initial values of the Python agents.
    fn layer(&mut self, agent: Agent, layer: usize, inputs: usize, hidden_size: usize) -> Recurrent {
        match agent {
            Agent::Gru => {
                let initial = Initial::Orthogonal(1, 2.0_f32.sqrt());
                let names = |part| ["weight", "bias"].map(|kind| format!("recurrent.{kind}_{part}_l{layer}"));
                let projection = self.recurrent(names("ih"), inputs, 3 * hidden_size, initial);
                let hidden = Some(self.recurrent(names("hh"), hidden_size, 3 * hidden_size, initial));
                Recurrent { inputs: projection, hidden }
            }
            Agent::MinGru => {
                let names = ["weight", "bias"].map(|kind| format!("cell.layers.{layer}.projection.{kind}"));
                let projection = self.recurrent(names, inputs, 2 * hidden_size, Initial::Orthogonal(2, 1.0));
                Recurrent { inputs: projection, hidden: None }
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
    fn new(start: usize, bias: usize, end: usize, inputs: usize) -> Self {
        Linear { weight: start..bias, bias: bias..end, inputs, packed: Packed::default() }
    }

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
    /// Choices of each branch of the action.
    pub choices: Vec<usize>,
    /// H, the size of the hidden state of each layer of the memory.
    pub hidden_size: usize,
    residual: bool,
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
    gru: gru::Workspace,
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
    /// A network with initial weights, drawn from the generator, for observations of this width and actions with these choices.
    pub fn new(settings: &Settings, width: usize, choices: &[usize], random: &mut Generator) -> Self {
        let (model, recurrence, root) = (&settings.model, &settings.recurrence, 2.0_f32.sqrt());
        let mut tensors = Tensors::default();
        let encoder = tensors.linear("encoder.vector.0", width, model.vector_width, root);
        let (hidden_size, mut inputs) = (recurrence.hidden_size, model.vector_width);
        let embedding = recurrence.embedding.then(|| tensors.linear("memory.embedding.0", inputs, hidden_size, root));
        inputs = if recurrence.embedding { hidden_size } else { inputs };
        let mut memory = Vec::new();
        for layer in 0..recurrence.layers {
            memory.push(tensors.layer(settings.agent, layer, inputs, hidden_size));
            inputs = hidden_size;
        }
        let body_width = if model.body_width > 0 { model.body_width } else { hidden_size };
        let body = tensors.linear("body.0", hidden_size, body_width, root);
        let policy_hidden = tensors.linear("policy.hidden.0", body_width, model.head_width, root);
        let branches: Vec<_> =
            choices.iter().enumerate().map(|(i, size)| (format!("policy.branches.{i}"), *size)).collect();
        // Small weights make the initial policy nearly uniform.
        let policy = tensors.branches(&branches, model.head_width, 0.1);
        let value_hidden = tensors.linear("value.layers.0", body_width, model.head_width, root);
        let value = tensors.linear("value.layers.2", model.head_width, 1, model.value_gain as f32);
        let Tensors { tensors, length } = tensors;
        let mut parameters = vec![0.0; length];
        for tensor in &tensors {
            let numbers = &mut parameters[tensor.range.clone()];
            match tensor.initial {
                Initial::Orthogonal(parts, gain) => {
                    numbers.fill_with(|| random.standard_normal() as f32);
                    let matrices = numbers.chunks_exact_mut(tensor.range.len() / parts);
                    matrices.for_each(|matrix| orthogonal(matrix, tensor.shape[1], gain));
                }
                Initial::Uniform(bound) => numbers.fill_with(|| bound * (2.0 * random.random_f32() - 1.0)),
                Initial::Zero => {}
            }
        }
        let choices = choices.to_vec();
        let residual = recurrence.residual;
        let mut network = Network {
            parameters,
            tensors,
            choices,
            hidden_size,
            residual,
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
        network
    }

    /// Number of layers of the memory.
    pub fn layers(&self) -> usize {
        self.memory.len()
    }

    /// Width of the observations.
    pub fn observation_width(&self) -> usize {
        self.encoder.inputs
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
        let p = &self.parameters[..];
        self.encoder.forward_relu(p, &pass.observations, &mut pass.encoded);
        if let Some(embedding) = &self.embedding {
            embedding.forward_relu(p, &pass.encoded, &mut pass.embedded);
        }
        let embedded = if self.embedding.is_some() { &pass.embedded } else { &pass.encoded };
        let steps = sequences.steps();
        pass.layers.resize_with(self.memory.len(), LayerPass::default);
        for (i, layer) in self.memory.iter().enumerate() {
            let (before, rest) = pass.layers.split_at_mut(i);
            let now = &mut rest[0];
            layer.inputs.forward(p, before.last().map_or(embedded, |layer| &layer.outputs), &mut now.inputs);
            now.outputs.resize(steps * self.hidden_size, 0.0);
            let (inputs, state) = (&now.inputs, &pass.states[i]);
            if let Some(hidden) = &layer.hidden {
                now.saved.resize(steps * gru::SAVED * self.hidden_size, 0.0);
                let (bias, workspace) = (&p[hidden.bias.clone()], &mut pass.gru);
                let (saved, outputs) = (&mut now.saved, &mut now.outputs);
                gru::forward(sequences, inputs, &hidden.packed, bias, state, saved, outputs, workspace);
            } else {
                now.saved.resize(steps * mingru::SAVED * self.hidden_size, 0.0);
                mingru::forward(sequences, inputs, state, &mut now.saved, &mut now.outputs);
            }
        }
        pass.remembered.clone_from(&pass.layers[self.memory.len() - 1].outputs);
        if self.residual {
            add(&mut pass.remembered, embedded);
        }
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
        if self.residual {
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
