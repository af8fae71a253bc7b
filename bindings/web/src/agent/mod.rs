//! Trained agents: the file that `endless_gym_agents.export` writes, and the policy network.

mod file;
mod network;
#[cfg(test)]
mod tests;

use endless_gym_core::envs::EnvSpec;
use endless_gym_core::random::{Generator, SeedSequence};
use serde_json::{Value as Json, json};

pub use file::AgentFileError;
use file::{Header, Tensors};
use network::Network;

/// A trained agent.
#[derive(Debug)]
pub struct Agent {
    header: Header,
    network: Network,
}

impl Agent {
    /// Reads the file of an agent.
    pub fn read(file: &[u8]) -> Result<Self, AgentFileError> {
        let (header, mut tensors) = Tensors::read(file)?;
        let network = Network::new(&header.branches, &mut tensors)?;
        Ok(Agent { header, network })
    }

    /// The id of the environment that it was trained in.
    pub fn env(&self) -> &str {
        &self.header.env
    }

    /// Whether its features and actions are those of that environment.
    pub fn fits(&self, spec: &EnvSpec) -> bool {
        self.header.env == spec.id
            && self.network.features() == spec.features.len()
            && spec.action_space.branches().iter().map(|choices| *choices as usize).eq(self
                .header
                .branches
                .iter()
                .copied())
    }

    /// The memory at the start of an episode with that seed. Actions are sampled from a different random stream than
    /// the environment's.
    pub fn memory(&self, seed: u64) -> Memory {
        let stream = SeedSequence::new(seed).with_spawn_key(&[1]);
        Memory { hidden: vec![0.0; self.network.hidden()], random: Generator::from_seed_sequence(&stream) }
    }

    /// Samples an action for the features of a step, and updates the memory.
    pub fn act(&self, features: &[f32], memory: &mut Memory, action: &mut [i32]) {
        let logits = self.network.step(features, &mut memory.hidden);
        let mut first = 0;
        for (number, choices) in action.iter_mut().zip(&self.header.branches) {
            *number = sample(&logits[first..first + choices], &mut memory.random) as i32;
            first += choices;
        }
    }

    /// The agent's description for the page.
    pub fn description(&self) -> Json {
        json!({
            "env": self.header.env,
            "options": self.header.options,
            "updates": self.header.updates,
            "steps": self.header.steps,
            "evaluation": self.header.evaluation,
        })
    }
}

/// An agent's state within an episode.
pub struct Memory {
    hidden: Vec<f32>,
    random: Generator,
}

/// Samples from the softmax with the Gumbel-max trick, as in training.
fn sample(logits: &[f32], random: &mut Generator) -> usize {
    let mut best = (0, f64::NEG_INFINITY);
    for (choice, logit) in logits.iter().enumerate() {
        // `1 - random` is in (0, 1], so the first logarithm is finite.
        let noise = -(-(1.0 - random.random()).ln()).ln();
        let value = f64::from(*logit) + noise;
        if value > best.1 {
            best = (choice, value);
        }
    }
    best.0
}
