//! Collection of segments: T steps of N environments, each of which continues the episodes of the one before.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use endless_gym_core::random::{Generator, SeedSequence};
use endless_gym_kernels::categorical;
use endless_gym_kernels::sequences::Sequences;

use crate::environments::Environments;
use crate::error::Error;
use crate::metrics::{Episode, final_infos};
use crate::network::{Network, Pass};
use crate::settings::Settings;
use crate::threads::{Threads, part};

/// Number of most recent episodes over which means are computed.
pub const RECENT: usize = 100;

/// Fewest environments for which acting in another thread pays.
const ENVS_PER_THREAD: usize = 16;

/// T steps of N environments. Step t of environment n is row t * N + n.
#[derive(Default)]
pub struct Segment {
    /// Observations before each step, (T N, width).
    pub observations: Vec<f32>,
    /// Whether the observation is the first of an episode, (T N,).
    pub starts: Vec<bool>,
    /// The choice in each branch, (T N, branches).
    pub actions: Vec<usize>,
    /// Log-probability of the choice in each branch, (T N, branches).
    pub log_probs: Vec<f32>,
    /// Value of the observation, (T N,).
    pub values: Vec<f32>,
    /// Reward of the step, (T N,).
    pub rewards: Vec<f32>,
    /// Whether the step ended its episode, (T N,).
    pub dones: Vec<bool>,
    /// Values of the observations after the last step, (N,).
    pub last_values: Vec<f32>,
    /// Hidden states before steps 0, L, 2 L, ... for sequences of length L, of each layer: (cuts, layers, N, H).
    pub stored: Vec<Vec<Vec<f32>>>,
}

/// Seconds of the phases of an update.
#[derive(Clone, Copy, Default)]
pub struct Clock {
    /// The environments, or waiting for them.
    pub stepping: Duration,
    /// Choosing actions.
    pub inference: Duration,
    /// Computing gradients and changing the weights.
    pub learning: Duration,
}

/// Plays with the agent.
pub struct Player {
    /// The environments.
    pub environments: Environments,
    /// The hidden states of each layer, (N, H) each.
    pub hidden: Vec<Vec<f32>>,
    /// Whether the next observation is the first of an episode, (N,).
    pub starts: Vec<bool>,
    /// The last episodes that ended, at most [`RECENT`].
    pub episodes: VecDeque<Episode>,
    /// The last segment.
    pub segment: Segment,
    steps: usize,
    sequence_length: usize,
    seed: u64,
    options: endless_gym_core::pool::OptionMap,
    passes: Vec<Pass>,
    sent: Vec<i32>,
}

impl Player {
    /// Starts episodes in all environments.
    ///
    /// # Errors
    ///
    /// Those of the environments.
    pub fn new(settings: &Settings, network: &Network, mut environments: Environments) -> Result<Self, Error> {
        let num_envs = settings.environment.num_envs;
        for group in 0..environments.groups {
            environments.reset(group)?;
            environments.receive(group)?;
        }
        Ok(Player {
            environments,
            hidden: vec![vec![0.0; num_envs * network.hidden_size]; network.layers()],
            starts: vec![true; num_envs],
            episodes: VecDeque::new(),
            segment: Segment::default(),
            steps: settings.ppo.steps,
            sequence_length: settings.recurrence.sequence_length,
            seed: settings.seed,
            options: settings.options()?,
            passes: Vec::new(),
            sent: Vec::new(),
        })
    }

    /// Collects the segment of an update, whose number decides its random numbers.
    ///
    /// # Errors
    ///
    /// Those of the environments.
    pub fn collect(
        &mut self,
        network: &Network,
        threads: &Threads,
        update: u64,
        clock: &mut Clock,
    ) -> Result<(), Error> {
        let (num_envs, groups) = (self.starts.len(), self.environments.groups);
        let (rows, branches) = (self.steps * num_envs, network.choices.len());
        let segment = &mut self.segment;
        segment.observations.resize(rows * network.observation_width(), 0.0);
        segment.actions.resize(rows * branches, 0);
        segment.log_probs.resize(rows * branches, 0.0);
        [&mut segment.values, &mut segment.rewards].into_iter().for_each(|part| part.resize(rows, 0.0));
        [&mut segment.starts, &mut segment.dones].into_iter().for_each(|part| part.resize(rows, false));
        segment.last_values.resize(num_envs, 0.0);
        segment.stored.clear();

        let mut random = generator(self.seed, Purpose::Actions, update);
        let mut noise = vec![0.0; num_envs * network.choices.iter().sum::<usize>()];
        for step in 0..self.steps {
            // Drawn for the environments of all groups, so that actions do not depend on the groups.
            noise.fill_with(|| categorical::gumbel(random.random_f32()));
            for group in 0..groups {
                if step > 0 {
                    self.receive(group, step - 1, clock)?;
                }
                if group == 0 && step % self.sequence_length == 0 {
                    self.segment.stored.push(self.hidden.clone());
                }
                self.act(network, threads, group, step, &noise, clock)?;
            }
        }
        for group in 0..groups {
            self.receive(group, self.steps - 1, clock)?;
            self.estimate(network, threads, group, clock);
        }
        Ok(())
    }

    /// Chooses and sends the actions of a group, and updates its hidden states while the environments step.
    fn act(
        &mut self,
        network: &Network,
        threads: &Threads,
        group: usize,
        step: usize,
        noise: &[f32],
        clock: &mut Clock,
    ) -> Result<(), Error> {
        let begin = Instant::now();
        let (num_envs, n, width) = (self.starts.len(), self.environments.per_group, network.observation_width());
        let (branches, choices) = (network.choices.len(), network.choices.iter().sum::<usize>());
        // Of the group among all environments, and among the rows of the segment.
        let (envs, rows) = (group * n..(group + 1) * n, step * num_envs + group * n..step * num_envs + (group + 1) * n);
        let segment = &mut self.segment;
        self.environments.observe(group, &mut segment.observations[rows.start * width..rows.end * width]);
        segment.starts[rows.clone()].copy_from_slice(&self.starts[envs.clone()]);
        let parts = self.forward(network, threads, group, step);
        let segment = &mut self.segment;
        for (i, pass) in self.passes[..parts].iter_mut().enumerate() {
            let part = part(n, i, parts);
            let rows = rows.start + part.start..rows.start + part.end;
            let noise = &noise[(envs.start + part.start) * choices..(envs.start + part.end) * choices];
            let actions = &mut segment.actions[rows.start * branches..rows.end * branches];
            categorical::log_softmax(&mut pass.logits, &network.choices);
            categorical::sample(&pass.logits, &network.choices, Some(noise), actions);
            let taken = &mut segment.log_probs[rows.start * branches..rows.end * branches];
            categorical::log_prob(&pass.logits, &network.choices, actions, taken);
            segment.values[rows].copy_from_slice(&pass.values);
        }
        self.sent.clear();
        let actions = &segment.actions[rows.start * branches..rows.end * branches];
        self.sent.extend(actions.iter().map(|action| *action as i32));
        clock.inference += begin.elapsed();
        let begin = Instant::now();
        self.environments.send(group, &self.sent)?;
        clock.stepping += begin.elapsed();
        let begin = Instant::now();
        for (i, pass) in self.passes[..parts].iter().enumerate() {
            let part = part(n, i, parts);
            for (layer, hidden) in self.hidden.iter_mut().enumerate() {
                let envs =
                    (envs.start + part.start) * network.hidden_size..(envs.start + part.end) * network.hidden_size;
                hidden[envs].copy_from_slice(pass.hidden(layer));
            }
        }
        self.starts[envs].fill(false);
        clock.inference += begin.elapsed();
        Ok(())
    }

    /// Waits for the result of a group's step.
    fn receive(&mut self, group: usize, step: usize, clock: &mut Clock) -> Result<(), Error> {
        let begin = Instant::now();
        self.environments.receive(group)?;
        let (num_envs, n) = (self.starts.len(), self.environments.per_group);
        if let Some(batch) = self.environments.batch(group) {
            for (env, reward) in batch.reward().iter().enumerate() {
                let (row, done) = (step * num_envs + group * n + env, batch.has_ended(env));
                self.segment.rewards[row] = *reward as f32;
                self.segment.dones[row] = done;
                self.starts[group * n + env] = done;
                if done {
                    self.episodes.push_back(final_infos(&self.environments.spec, &self.options, &batch, env));
                }
            }
        }
        self.episodes.drain(..self.episodes.len().saturating_sub(RECENT));
        clock.stepping += begin.elapsed();
        Ok(())
    }

    /// Estimates the values after the last step, without updating the hidden states.
    fn estimate(&mut self, network: &Network, threads: &Threads, group: usize, clock: &mut Clock) {
        let begin = Instant::now();
        let n = self.environments.per_group;
        let parts = self.forward(network, threads, group, self.steps);
        for (i, pass) in self.passes[..parts].iter().enumerate() {
            let part = part(n, i, parts);
            self.segment.last_values[group * n + part.start..group * n + part.end].copy_from_slice(&pass.values);
        }
        clock.inference += begin.elapsed();
    }

    /// Computes one step of a group in parts, and returns their number. The observations are those of a step in the segment, or
    /// after its end the current ones.
    fn forward(&mut self, network: &Network, threads: &Threads, group: usize, step: usize) -> usize {
        let (num_envs, n, width) = (self.starts.len(), self.environments.per_group, network.observation_width());
        let parts = threads.count.min(n / ENVS_PER_THREAD).max(1);
        if self.passes.len() < parts {
            self.passes.resize_with(parts, Pass::default);
        }
        let mut current = Vec::new();
        let observations = if step < self.steps {
            &self.segment.observations[(step * num_envs + group * n) * width..][..n * width]
        } else {
            current.resize(n * width, 0.0);
            self.environments.observe(group, &mut current);
            &current
        };
        let (hidden, starts) = (&self.hidden, &self.starts[group * n..(group + 1) * n]);
        threads.for_each(&mut self.passes[..parts], |i, pass| {
            let part = part(n, i, parts);
            copy(&mut pass.observations, &observations[part.start * width..part.end * width]);
            pass.states.resize_with(network.layers(), Vec::new);
            for (state, hidden) in pass.states.iter_mut().zip(hidden) {
                let size = network.hidden_size;
                copy(state, &hidden[(group * n + part.start) * size..(group * n + part.end) * size]);
            }
            let sizes = [part.len()];
            let sequences = Sequences::new(&sizes, &starts[part]).expect("one step of each environment");
            network.forward(sequences, pass);
        });
        parts
    }
}

/// Replaces the content of a vector, whose memory stays.
pub fn copy<T: Copy>(to: &mut Vec<T>, from: &[T]) {
    to.clear();
    to.extend_from_slice(from);
}

/// What random numbers are for.
#[derive(Clone, Copy)]
pub enum Purpose {
    /// Initial weights.
    Weights,
    /// Sampling of actions.
    Actions,
    /// Shuffling of minibatches.
    Minibatches,
}

/// The generator for a purpose in an update. Each update has its own, so that a resumed run continues exactly without a saved state.
pub fn generator(seed: u64, purpose: Purpose, update: u64) -> Generator {
    // numpy's SeedSequence(seed, spawn_key=(purpose, update)).
    let key = [purpose as u32, update as u32, (update >> 32) as u32];
    let key = if key[2] == 0 { &key[..2] } else { &key[..] };
    Generator::from_seed_sequence(&SeedSequence::new(seed).with_spawn_key(key))
}
