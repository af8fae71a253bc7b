//! The network of the settings, with its initial weights. The crate `endless-gym-kernels` computes it.

use std::convert::Infallible;

use endless_gym_core::random::Generator;
use endless_gym_kernels::network::{Memory, Network, NetworkSpec, Tensor};
use endless_gym_kernels::orthogonal::orthogonal;

use crate::settings::{Agent, Settings};

/// A network with initial weights, drawn from the generator, for observations of this width and actions with these choices.
pub fn new(settings: &Settings, observation_width: usize, choices: Vec<usize>, random: &mut Generator) -> Network {
    let (model, recurrence) = (&settings.model, &settings.recurrence);
    let has_memory = settings.agent != Agent::None;
    let spec = NetworkSpec {
        observation_width,
        encoder_width: model.vector_width,
        embedding: has_memory && recurrence.embedding,
        memory: if settings.agent == Agent::MinGru { Memory::MinGru } else { Memory::Gru },
        layers: if has_memory { recurrence.layers } else { 0 },
        hidden_size: recurrence.hidden_size,
        residual: has_memory && recurrence.residual,
        body_width: if model.body_width > 0 { model.body_width } else { recurrence.hidden_size },
        head_width: model.head_width,
        choices,
    };
    // Of the last weight, whose bias comes after it.
    let mut inputs = 1;
    let initial = |tensor: &Tensor| {
        let mut numbers = vec![0.0; tensor.range.len()];
        let is = |part| tensor.name.starts_with(part);
        if let [_, columns] = *tensor.shape {
            inputs = columns;
            numbers.fill_with(|| random.standard_normal() as f32);
            // Small weights make the initial policy nearly uniform. A minGRU's projection is two matrices.
            let (parts, gain) = match () {
                () if is("policy.branches.") => (1, 0.1),
                () if is("value.layers.2.") => (1, model.value_gain as f32),
                () if is("memory.cell.") => (2, 1.0),
                () => (1, 2.0_f32.sqrt()),
            };
            let matrices = numbers.chunks_exact_mut(tensor.range.len() / parts);
            matrices.for_each(|matrix| orthogonal(matrix, columns, gain));
        } else if !is("memory.recurrent.") && !is("memory.cell.") {
            // As PyTorch's `nn.Linear`.
            let bound = 1.0 / (inputs as f32).sqrt();
            numbers.fill_with(|| bound * (2.0 * random.random_f32() - 1.0));
        }
        Ok(numbers)
    };
    let Ok(network) = Network::new::<Infallible>(spec, initial);
    network
}
