//! Collection of segments: T steps of N environments, each of which continues the episodes of the one before.

use std::collections::VecDeque;
use std::ops::Range;
use std::time::{Duration, Instant};

use endless_gym_core::random::{Generator, SeedSequence};
use endless_gym_kernels::categorical;
use endless_gym_kernels::sequences::Sequences;

use crate::environments::Environments;
use crate::error::Error;
use crate::metrics::{Episode, final_infos};
use crate::settings::Settings;
use crate::threads::{Threads, part};
use endless_gym_kernels::network::{Network, Pass};

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

/// What a segment continues.
#[derive(Clone, Default)]
pub struct State {
    /// The hidden states of each layer, (N, H) each.
    pub hidden: Vec<Vec<f32>>,
    /// Whether the next observation is the first of an episode, (N,).
    pub starts: Vec<bool>,
    /// The last actions, (N, branches), if the next observations include them.
    pub actions: Vec<i32>,
    /// The last episodes that ended, at most [`RECENT`].
    pub episodes: VecDeque<Episode>,
    /// Snapshots of the N environments.
    pub snapshots: Vec<Vec<u8>>,
}

/// Plays with the agent.
pub struct Player {
    /// The environments.
    pub environments: Environments,
    /// The last segment.
    pub segment: Segment,
    /// Between two segments: what the next one continues. Its snapshots are made by [`state`](Self::state).
    state: State,
    steps: usize,
    sequence_length: usize,
    seed: u64,
    /// The parts of each group that threads compute.
    parts: Vec<Vec<Part>>,
    sent: Vec<i32>,
}

/// Environments that one thread computes.
struct Part {
    /// Numbers among the environments of all groups.
    envs: Range<usize>,
    pass: Pass,
}

impl Player {
    /// Starts episodes in all environments.
    pub fn new(
        settings: &Settings,
        network: &Network,
        threads: &Threads,
        mut environments: Environments,
    ) -> Result<Self, Error> {
        let (num_envs, n) = (settings.environment.num_envs, environments.per_group);
        let (count, mut parts) = (threads.count.min(n / ENVS_PER_THREAD).max(1), Vec::new());
        for group in 0..environments.groups {
            environments.reset(group)?;
            environments.receive(group)?;
            let envs = (0..count).map(|i| part(n, i, count)).map(|envs| group * n + envs.start..group * n + envs.end);
            parts.push(envs.map(|envs| Part { envs, pass: Pass::default() }).collect());
        }
        let branches = if environments.has_previous_action() { network.spec.choices.len() } else { 0 };
        Ok(Player {
            environments,
            segment: Segment::default(),
            state: State {
                hidden: vec![vec![0.0; num_envs * network.spec.hidden_size]; network.spec.layers],
                starts: vec![true; num_envs],
                actions: vec![0; num_envs * branches],
                ..State::default()
            },
            steps: settings.ppo.steps,
            sequence_length: settings.sequence_length(),
            seed: settings.seed,
            parts,
            sent: Vec::new(),
        })
    }

    /// The state between two segments.
    pub fn state(&mut self) -> Result<State, Error> {
        self.state.snapshots = self.environments.snapshots()?;
        Ok(self.state.clone())
    }

    /// Continues from a state.
    pub fn restore(&mut self, state: State) -> Result<(), Error> {
        self.environments.restore(&state.snapshots)?;
        self.state = state;
        (0..self.environments.groups).try_for_each(|group| self.environments.receive(group))
    }

    /// The last episodes that ended, at most [`RECENT`].
    pub fn episodes(&self) -> &VecDeque<Episode> {
        &self.state.episodes
    }

    /// Collects the segment of an update, whose number decides its random numbers.
    pub fn collect(
        &mut self,
        network: &Network,
        threads: &Threads,
        update: u64,
        clock: &mut Clock,
    ) -> Result<(), Error> {
        let (num_envs, groups) = (self.state.starts.len(), self.environments.groups);
        let (rows, branches) = (self.steps * num_envs, network.spec.choices.len());
        let segment = &mut self.segment;
        segment.observations.resize(rows * network.spec.observation_width, 0.0);
        segment.actions.resize(rows * branches, 0);
        segment.log_probs.resize(rows * branches, 0.0);
        [&mut segment.values, &mut segment.rewards].into_iter().for_each(|part| part.resize(rows, 0.0));
        [&mut segment.starts, &mut segment.dones].into_iter().for_each(|part| part.resize(rows, false));
        segment.last_values.resize(num_envs, 0.0);
        segment.stored.clear();

        let mut random = generator(self.seed, Purpose::Actions, update);
        let mut noise = vec![0.0; num_envs * network.spec.choices.iter().sum::<usize>()];
        for step in 0..self.steps {
            // Drawn for the environments of all groups, so that actions do not depend on the groups.
            noise.fill_with(|| categorical::gumbel(random.random_f32()));
            for group in 0..groups {
                if step > 0 {
                    self.receive(group, step - 1, clock)?;
                }
                if group == 0 && step % self.sequence_length == 0 {
                    self.segment.stored.push(self.state.hidden.clone());
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
        self.forward(network, threads, group);
        let (num_envs, choices, segment) = (self.state.starts.len(), &network.spec.choices, &mut self.segment);
        self.sent.clear();
        for Part { envs, pass } in &mut self.parts[group] {
            let rows = step * num_envs + envs.start..step * num_envs + envs.end;
            segment.observations[times(&rows, network.spec.observation_width)].copy_from_slice(&pass.observations);
            segment.starts[rows.clone()].copy_from_slice(&self.state.starts[envs.clone()]);
            segment.values[rows.clone()].copy_from_slice(&pass.values);
            let actions = &mut segment.actions[times(&rows, choices.len())];
            categorical::log_softmax(&mut pass.logits, choices);
            categorical::sample(&pass.logits, choices, Some(&noise[times(envs, choices.iter().sum())]), actions);
            let taken = &mut segment.log_probs[times(&rows, choices.len())];
            categorical::log_prob(&pass.logits, choices, actions, taken);
            self.sent.extend(actions.iter().map(|action| *action as i32));
        }
        clock.inference += begin.elapsed();
        let begin = Instant::now();
        self.environments.send(group, &self.sent)?;
        if let Some(actions) = self.state.actions.chunks_exact_mut(self.sent.len()).nth(group) {
            actions.copy_from_slice(&self.sent);
        }
        clock.stepping += begin.elapsed();
        let begin = Instant::now();
        for Part { envs, pass } in &self.parts[group] {
            for (layer, hidden) in self.state.hidden.iter_mut().enumerate() {
                hidden[times(envs, network.spec.hidden_size)].copy_from_slice(pass.hidden(layer));
            }
            self.state.starts[envs.clone()].fill(false);
        }
        clock.inference += begin.elapsed();
        Ok(())
    }

    /// Waits for the result of a group's step.
    fn receive(&mut self, group: usize, step: usize, clock: &mut Clock) -> Result<(), Error> {
        let begin = Instant::now();
        self.environments.receive(group)?;
        let (num_envs, n) = (self.state.starts.len(), self.environments.per_group);
        if let Some(batch) = self.environments.batch(group) {
            for (env, reward) in batch.reward().iter().enumerate() {
                let (row, done) = (step * num_envs + group * n + env, batch.has_ended(env));
                self.segment.rewards[row] = *reward as f32;
                self.segment.dones[row] = done;
                self.state.starts[group * n + env] = done;
                if done {
                    self.state.episodes.push_back(final_infos(&self.environments.spec, &batch, env));
                }
            }
        }
        self.state.episodes.drain(..self.state.episodes.len().saturating_sub(RECENT));
        clock.stepping += begin.elapsed();
        Ok(())
    }

    /// Estimates the values after the last step, without updating the hidden states.
    fn estimate(&mut self, network: &Network, threads: &Threads, group: usize, clock: &mut Clock) {
        let begin = Instant::now();
        self.forward(network, threads, group);
        for Part { envs, pass } in &self.parts[group] {
            self.segment.last_values[envs.clone()].copy_from_slice(&pass.values);
        }
        clock.inference += begin.elapsed();
    }

    /// Computes the current step of a group, in its parts.
    fn forward(&mut self, network: &Network, threads: &Threads, group: usize) {
        let (first, width) = (group * self.environments.per_group, network.spec.observation_width);
        let (environments, hidden, starts) = (&self.environments, &self.state.hidden, &self.state.starts);
        let mut observations = vec![0.0; environments.per_group * width];
        let envs = first..first + environments.per_group;
        let actions = self.state.actions.get(times(&envs, network.spec.choices.len())).unwrap_or_default();
        environments.observe(group, &starts[envs], actions, &mut observations);
        threads.for_each(&mut self.parts[group], |_, Part { envs, pass }| {
            copy(&mut pass.observations, &observations[times(&(envs.start - first..envs.end - first), width)]);
            pass.states.resize_with(hidden.len(), Vec::new);
            for (state, hidden) in pass.states.iter_mut().zip(hidden) {
                copy(state, &hidden[times(envs, network.spec.hidden_size)]);
            }
            let sequences = Sequences::new(envs.len(), &starts[envs.clone()]).expect("one step of each environment");
            network.forward(sequences, pass);
        });
    }
}

/// The numbers of rows of this width.
fn times(rows: &Range<usize>, width: usize) -> Range<usize> {
    rows.start * width..rows.end * width
}

/// Replaces the content of a vector, whose memory stays.
fn copy<T: Copy>(to: &mut Vec<T>, from: &[T]) {
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
