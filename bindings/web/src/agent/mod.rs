//! Trained agents that observe features: files of `endless learn` and of `endless_gym_agents.export`, in the format safetensors.

mod linear_attention;
#[cfg(test)]
mod tests;

use endless_gym_core::envs::EnvSpec;
use endless_gym_core::random::{Generator, SeedSequence};
use endless_gym_kernels::categorical;
use endless_gym_kernels::file::{self, File, FileError, PAGE_AGENTS};
use endless_gym_kernels::network::{Memory as Layers, Network, NetworkSpec, Pass};
use endless_gym_kernels::sequences::Sequences;
use linear_attention::{Kind, Sizes, Stack, State};
use safetensors::{Dtype, SafeTensors};
use serde::Deserialize;
use serde_json::{Map, Value as Json, json};
use thiserror::Error;

/// Largest size of a layer, and number of recurrent layers. With these, the number of weights fits into 32 bits.
const MAX_SIZE: usize = 4096;
const MAX_LAYERS: usize = 16;

/// A file that is not an agent, or one that cannot act.
#[derive(Debug, Error)]
pub enum AgentFileError {
    #[error("the file of the agent {0}")]
    File(#[from] FileError),
    #[error("the file has weights only; export the agent with --out, or open a checkpoint of `endless learn`")]
    WeightsOnly,
    #[error("the header of an agent cannot be read: {0}")]
    Header(#[from] serde_json::Error),
    #[error("an agent on the page must be one of {}, got {given}", PAGE_AGENTS.map(|(name, _)| name).join(", "))]
    Kind { given: String },
    #[error("the agent must have a float32 tensor `{name}` of shape {expected}, got {given}")]
    Tensor { name: String, expected: String, given: String },
    #[error(
        "the {heads} heads of the agent's memory must divide {channels} channels with at least one key each, and its {width} inputs \
         must be the {given} outputs of the layer before"
    )]
    Heads { heads: usize, channels: usize, width: usize, given: usize },
    #[error("the weights of an agent must be finite, got {given} in `{name}`")]
    NotFinite { name: String, given: f32 },
}

/// The header of a file.
#[derive(Debug, Deserialize)]
struct Header {
    update: u64,
    steps: u64,
    /// Only of exported agents.
    #[serde(default)]
    evaluation: Vec<Json>,
    settings: Settings,
}

#[derive(Debug, Deserialize)]
struct Settings {
    env: String,
    agent: String,
    environment: Environment,
    recurrence: Recurrence,
}

#[derive(Debug, Deserialize)]
struct Environment {
    option: Vec<String>,
}

#[derive(Debug, Deserialize)]
struct Recurrence {
    residual: bool,
}

/// A trained agent.
pub struct Agent {
    header: Header,
    network: Network,
    /// A memory that is not one of the network's.
    stack: Option<Stack>,
}

/// An agent's state within an episode.
pub struct Memory {
    pass: Pass,
    stack: Vec<State>,
    random: Generator,
}

impl Agent {
    /// Reads the file of an agent.
    pub fn read(file: &[u8]) -> Result<Self, AgentFileError> {
        let File { tensors, header } = file::read(file)?;
        let header: Header = serde_json::from_str(&header.ok_or(AgentFileError::WeightsOnly)?)?;
        let spec = network_spec(&header.settings, &tensors)?;
        let network = Network::new(spec, |tensor| weights(&tensors, &tensor.name, &tensor.shape))?;
        let stack = kind(&header.settings).map(|kind| stack(kind, &network.spec, &tensors)).transpose()?;
        Ok(Agent { header, network, stack })
    }

    /// The id of the environment that it was trained in.
    pub fn env(&self) -> &str {
        // The Python agents write Gymnasium's id, with a namespace.
        self.header.settings.env.rsplit('/').next().unwrap_or_default()
    }

    /// Whether its features and actions are those of that environment.
    pub fn fits(&self, spec: &EnvSpec) -> bool {
        let choices = spec.action_space.branches().iter().map(|choices| *choices as usize);
        self.env() == spec.id
            && self.network.spec.observation_width == spec.features.len()
            && choices.eq(self.network.spec.choices.iter().copied())
    }

    /// The memory at the start of an episode with that seed. Actions are sampled from a different random stream than
    /// the environment's.
    pub fn memory(&self, seed: u64) -> Memory {
        let stream = SeedSequence::new(seed).with_spawn_key(&[1]);
        let (spec, mut pass) = (&self.network.spec, Pass::default());
        pass.states = vec![vec![0.0; spec.hidden_size]; spec.layers];
        let stack = self.stack.as_ref().map(Stack::start).unwrap_or_default();
        Memory { pass, stack, random: Generator::from_seed_sequence(&stream) }
    }

    /// Samples an action for the features of a step, and updates the memory.
    pub fn act(&self, features: &[f32], memory: &mut Memory, action: &mut [i32]) {
        self.step(features, memory);
        let choices = &self.network.spec.choices;
        let noise: Vec<f32> =
            memory.pass.logits.iter().map(|_| categorical::gumbel(memory.random.random_f32())).collect();
        let mut chosen = vec![0; choices.len()];
        categorical::sample(&memory.pass.logits, choices, Some(&noise), &mut chosen);
        action.iter_mut().zip(chosen).for_each(|(action, chosen)| *action = chosen as i32);
    }

    /// Computes the logits of all branches, and the states after the step.
    fn step(&self, features: &[f32], Memory { pass, stack: states, .. }: &mut Memory) {
        pass.observations.clear();
        pass.observations.extend_from_slice(features);
        if let Some(stack) = &self.stack {
            return self.network.forward_with(pass, |x| stack.step(x, states));
        }
        self.network.forward(Sequences::new(1, &[false]).expect("one step"), pass);
        for layer in 0..pass.states.len() {
            let after = pass.hidden(layer).to_vec();
            pass.states[layer] = after;
        }
    }

    /// The agent's description for the page.
    pub fn description(&self) -> Json {
        let Header { update, steps, evaluation, settings } = &self.header;
        let option = |given: &String| {
            let (name, value) = given.split_once('=')?;
            Some((name.to_owned(), serde_json::from_str(value).unwrap_or_else(|_| Json::from(value))))
        };
        let options: Map<String, Json> = settings.environment.option.iter().filter_map(option).collect();
        let (env, agent) = (self.env(), &settings.agent);
        json!({
            "env": env,
            "agent": agent,
            "title": PAGE_AGENTS.iter().find(|(name, _)| name == agent).map(|(_, title)| title),
            "options": options,
            "updates": update,
            "steps": steps,
            "evaluation": evaluation,
        })
    }
}

/// The kind of a memory that is not one of the network's.
fn kind(settings: &Settings) -> Option<Kind> {
    match &*settings.agent {
        "gated-deltanet" => Some(Kind::GatedDeltaNet),
        "mamba2" => Some(Kind::Mamba2),
        "retnet" => Some(Kind::RetNet),
        _ => None,
    }
}

/// The size of a tensor on an axis, 1 to `MAX_SIZE`.
fn size(tensors: &SafeTensors, name: &str, axis: usize) -> Result<usize, AgentFileError> {
    let given = tensors.tensor(name).map(|tensor| tensor.shape().to_vec()).ok();
    let size = given.as_ref().and_then(|shape| shape.get(axis).copied());
    size.filter(|size| (1..=MAX_SIZE).contains(size)).ok_or_else(|| AgentFileError::Tensor {
        name: name.to_owned(),
        expected: format!("1 to {MAX_SIZE} on axis {axis}"),
        given: given.map_or_else(|| "none".to_owned(), |shape| format!("{shape:?}")),
    })
}

/// How many of the layers that `name` gives the name of a tensor for are in the file.
fn count(tensors: &SafeTensors, name: impl Fn(usize) -> String) -> usize {
    (0..MAX_LAYERS).take_while(|layer| tensors.tensor(&name(*layer)).is_ok()).count()
}

/// Kinds and sizes of the layers, from the shapes of a file's tensors.
fn network_spec(settings: &Settings, tensors: &SafeTensors) -> Result<NetworkSpec, AgentFileError> {
    let size = |name: &str, axis: usize| size(tensors, name, axis);
    let gru = |layer: usize| format!("memory.recurrent.bias_hh_l{layer}");
    let mingru = |layer: usize| format!("memory.cell.layers.{layer}.projection.bias");
    let (memory, layers, hidden_size) = match &*settings.agent {
        "gru" => (Layers::Gru, count(tensors, gru), size("memory.recurrent.weight_hh_l0", 1)?),
        "mingru" => (Layers::MinGru, count(tensors, mingru), size(&mingru(0), 0)?.div_ceil(2)),
        "none" => (Layers::Gru, 0, 1),
        _ if kind(settings).is_some() => (Layers::Gru, 0, size("memory.cell.norms.0.weight", 0)?),
        given => return Err(AgentFileError::Kind { given: given.to_owned() }),
    };
    let branch = |branch: usize| format!("policy.branches.{branch}.weight");
    // Without the first one, that is an error.
    let choices = (0..count(tensors, branch).max(1)).map(|i| size(&branch(i), 0));
    Ok(NetworkSpec {
        observation_width: size("encoder.vector.0.weight", 1)?,
        encoder_width: size("encoder.vector.0.weight", 0)?,
        embedding: tensors.tensor("memory.embedding.0.weight").is_ok(),
        memory,
        layers,
        hidden_size,
        residual: layers > 0 && settings.recurrence.residual,
        body_width: size("body.0.weight", 0)?,
        head_width: size("policy.hidden.0.weight", 0)?,
        choices: choices.collect::<Result<_, _>>()?,
    })
}

/// The layers of linear attention between the others.
fn stack(kind: Kind, spec: &NetworkSpec, tensors: &SafeTensors) -> Result<Stack, AgentFileError> {
    let layers = count(tensors, |layer| format!("memory.cell.layers.{layer}.enter.weight"));
    let size = |name: &str, axis: usize| size(tensors, &format!("memory.cell.layers.0.{name}"), axis);
    let (width, inner) = (spec.hidden_size, size("leave.weight", 1)?);
    let heads = size(if kind == Kind::RetNet { "gamma" } else { "a_log" }, 0)?;
    let keys = match kind {
        Kind::GatedDeltaNet => size("convolution.weight", 1)?.saturating_sub(inner) / (2 * heads),
        Kind::Mamba2 => size("convolution.weight", 1)?.saturating_sub(inner) / 2,
        Kind::RetNet => width / heads,
    };
    let feed_forward = if kind == Kind::Mamba2 { 0 } else { size("feed_forward.leave.weight", 1)? };
    let inputs = if spec.embedding { width } else { spec.encoder_width };
    if keys == 0 || heads == 0 || inner % heads != 0 || inputs != width {
        return Err(AgentFileError::Heads { heads, channels: inner, width, given: inputs });
    }
    Stack::new(kind, layers, Sizes { width, heads, inner, keys, feed_forward }, |name, shape| {
        weights(tensors, &name, shape)
    })
}

/// The weights of a tensor.
fn weights(tensors: &SafeTensors, name: &str, shape: &[usize]) -> Result<Vec<f32>, AgentFileError> {
    let found = tensors.tensor(name).ok();
    let Some(view) = found.as_ref().filter(|view| view.dtype() == Dtype::F32 && view.shape() == shape) else {
        return Err(AgentFileError::Tensor {
            name: name.to_owned(),
            expected: format!("{shape:?}"),
            given: found.map_or_else(|| "none".to_owned(), |view| format!("{:?} {:?}", view.dtype(), view.shape())),
        });
    };
    let (numbers, _) = view.data().as_chunks();
    let weights: Vec<f32> = numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    match weights.iter().find(|weight| !weight.is_finite()) {
        Some(given) => Err(AgentFileError::NotFinite { name: name.to_owned(), given: *given }),
        None => Ok(weights),
    }
}
