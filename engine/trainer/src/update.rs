//! Proximal policy optimisation (Schulman et al., 2017) on one segment, as the Python agents' `ppo.py`.

use endless_gym_core::random::Generator;
use endless_gym_kernels::adamw::{AdamW, clip_norm};
use endless_gym_kernels::sequences::Sequences;
use endless_gym_kernels::{categorical, ppo};

use crate::minibatches::{minibatches, rows, sequences, shards};
use crate::rollout::Segment;
use crate::settings::{Ppo, Scope, Settings};
use crate::threads::{Threads, part};
use endless_gym_kernels::network::{Network, Pass};

/// The metrics of an update by name, in the order of the columns.
pub type Metrics = Vec<(&'static str, f64)>;

/// What changes the weights.
pub struct Learner {
    /// The optimizer.
    pub optimizer: AdamW,
    shards: Vec<Shard>,
}

/// A shard of a minibatch, with the memory that minibatches reuse.
#[derive(Default)]
struct Shard {
    pass: Pass,
    sequences: Vec<usize>,
    rows: Vec<usize>,
    resets: Vec<bool>,
    actions: Vec<usize>,
    /// Its part of the minibatch's sequences.
    share: f64,
    losses: [f64; LOSSES.len()],
}

/// The means over minibatches, in the order of the columns.
const LOSSES: [&str; 6] = ["loss", "policy_loss", "value_loss", "entropy", "kl_divergence", "clip_fraction"];

/// Targets of a segment, (T N,) each.
struct Targets {
    advantages: Vec<f32>,
    returns: Vec<f32>,
}

/// Interpolates linearly from `initial` at update 0 to `last` at update `over`, and returns `last` after that.
pub fn linear_decay(initial: f64, last: f64, update: u64, over: u64) -> f64 {
    last + (initial - last) * (1.0 - update as f64 / over as f64).max(0.0)
}

impl Learner {
    /// A learner of so many parameters.
    pub fn new(parameters: usize) -> Self {
        Learner { optimizer: AdamW::new(parameters), shards: Vec::new() }
    }

    /// Changes the weights of the network by one segment, and returns the metrics of this update, which is counted from 0.
    pub fn learn(
        &mut self,
        network: &mut Network,
        segment: &Segment,
        settings: &Settings,
        update: u64,
        random: &mut Generator,
        threads: &Threads,
    ) -> Metrics {
        let ppo = &settings.ppo;
        let decay = |initial, last| linear_decay(initial, last, update, ppo.decay_updates);
        let learning_rate = decay(ppo.learning_rate, ppo.final_learning_rate);
        let entropy_coefficient = decay(ppo.entropy_coefficient, ppo.final_entropy_coefficient);
        let num_envs = segment.last_values.len();
        let mut advantages = generalised_advantages(segment, num_envs, ppo.gamma, ppo.gae_lambda);
        let returns: Vec<f32> = advantages.iter().zip(&segment.values).map(|(a, v)| a + v).collect();
        let mut metrics = vec![
            ("learning_rate", learning_rate),
            ("entropy_coefficient", entropy_coefficient),
            ("value", moments(&segment.values).0),
            ("advantage", moments(&advantages).0),
            ("explained_variance", explained_variance(&segment.values, &returns)),
        ];
        if ppo.advantage_normalisation == Scope::Batch {
            normalise(&mut advantages);
        }
        let targets = Targets { advantages, returns };
        let length = settings.sequence_length();
        let all = sequences(ppo.steps, num_envs, length);
        let (mut losses, mut norms, mut count) = ([0.0; LOSSES.len()], 0.0, 0.0);
        for _ in 0..ppo.epochs {
            for minibatch in minibatches(&all, ppo.minibatches, random) {
                let parts = shards(&minibatch);
                self.shards.resize_with(self.shards.len().max(parts.len()), Shard::default);
                let parts_count = parts.len();
                let normal = match ppo.advantage_normalisation {
                    Scope::Minibatch => scale_of(&minibatch, num_envs, length, &targets.advantages),
                    Scope::None | Scope::Batch => (0.0, 1.0),
                };
                for (shard, sequences) in self.shards.iter_mut().zip(parts) {
                    shard.share = sequences.len() as f64 / minibatch.len() as f64;
                    shard.sequences = sequences;
                }
                let shards = &mut self.shards[..parts_count];
                let frozen = &*network;
                threads.for_each(shards, |_, shard| {
                    shard.compute(frozen, segment, &targets, normal, settings, entropy_coefficient);
                });
                sum_gradients(shards, threads);
                for shard in &*shards {
                    losses.iter_mut().zip(shard.losses).for_each(|(sum, loss)| *sum += shard.share * loss);
                }
                let gradients = &mut shards[0].pass.gradients;
                norms += f64::from(clip_norm(gradients, ppo.max_gradient_norm as f32));
                count += 1.0;
                self.optimizer.update(&mut network.parameters, gradients, learning_rate);
                network.pack();
            }
        }
        metrics.extend(LOSSES.into_iter().zip(losses).map(|(name, sum)| (name, sum / count)));
        metrics.push(("gradient_norm", norms / count));
        let square: f64 = network.parameters.iter().map(|w| f64::from(*w) * f64::from(*w)).sum();
        metrics.push(("weight_norm", square.sqrt()));
        metrics
    }
}

impl Shard {
    /// Computes the losses and gradients of the shard, each the mean over its steps.
    fn compute(
        &mut self,
        network: &Network,
        segment: &Segment,
        targets: &Targets,
        (mean, deviation): (f32, f32),
        settings: &Settings,
        entropy_coefficient: f64,
    ) {
        let (num_envs, branches, width) =
            (segment.last_values.len(), network.spec.choices.len(), network.spec.observation_width);
        let length = settings.sequence_length();
        self.rows.clear();
        self.rows.extend(rows(&self.sequences, num_envs, length));
        let (rows, steps, pass) = (&self.rows[..], self.rows.len(), &mut self.pass);
        gather(rows, &segment.observations, width, &mut pass.observations);
        gather(rows, &segment.actions, branches, &mut self.actions);
        gather(rows, &segment.starts, 1, &mut self.resets);
        pass.states.resize_with(network.spec.layers, Vec::new);
        for (layer, state) in pass.states.iter_mut().enumerate() {
            state.clear();
            for first in &self.sequences {
                let (stored, env) = (&segment.stored[first / num_envs / length][layer], first % num_envs);
                let size = network.spec.hidden_size;
                state.extend_from_slice(&stored[env * size..(env + 1) * size]);
            }
        }
        let sequences = Sequences::new(self.sequences.len(), &self.resets).expect("sequences of the same length");
        network.forward(sequences, pass);
        categorical::log_softmax(&mut pass.logits, &network.spec.choices);
        let of = |all: &[f32]| rows.iter().map(|row| all[*row]).collect::<Vec<f32>>();
        let (mut taken, mut old_taken, mut entropies) = (vec![0.0; steps * branches], Vec::new(), vec![0.0; steps]);
        categorical::log_prob(&pass.logits, &network.spec.choices, &self.actions, &mut taken);
        categorical::entropy(&pass.logits, &network.spec.choices, &mut entropies);
        gather(rows, &segment.log_probs, branches, &mut old_taken);
        let mut advantages = of(&targets.advantages);
        advantages.iter_mut().for_each(|advantage| *advantage = (*advantage - mean) / deviation);

        let Ppo { clip_range, value_coefficient, .. } = settings.ppo;
        let mut grad_taken = vec![0.0; taken.len()];
        let policy_loss = ppo::policy_loss(&taken, &old_taken, &advantages, clip_range as f32, &mut grad_taken);
        pass.grad_values.resize(steps, 0.0);
        let (old_values, returns) = (of(&segment.values), of(&targets.returns));
        let value_loss = ppo::value_loss(&pass.values, &old_values, &returns, clip_range as f32, &mut pass.grad_values);
        pass.grad_values.iter_mut().for_each(|grad| *grad *= value_coefficient as f32);
        let grad_entropy = vec![(-entropy_coefficient / steps as f64) as f32; steps];
        pass.grad_logits.resize(pass.logits.len(), 0.0);
        let grad_logits = &mut pass.grad_logits;
        categorical::backward(
            &pass.logits,
            &network.spec.choices,
            &self.actions,
            &grad_taken,
            &grad_entropy,
            grad_logits,
        );
        network.backward(sequences, pass);

        let entropy = moments(&entropies).0;
        let loss = f64::from(policy_loss) + value_coefficient * f64::from(value_loss) - entropy_coefficient * entropy;
        let log_ratios = taken.iter().zip(&old_taken).map(|(now, before)| f64::from(now - before));
        let (mut divergence, mut clipped) = (0.0, 0.0);
        for log_ratio in log_ratios {
            // Schulman's k3 estimator of the KL divergence: unbiased and never negative (joschu.net/blog/kl-approx.html).
            divergence += log_ratio.exp() - 1.0 - log_ratio;
            clipped += f64::from(u8::from((log_ratio.exp() - 1.0).abs() > clip_range));
        }
        let choices = taken.len() as f64;
        let (policy_loss, value_loss) = (policy_loss.into(), value_loss.into());
        self.losses = [loss, policy_loss, value_loss, entropy, divergence / choices, clipped / choices];
    }
}

/// Replaces the gradients of the first shard by the sum over all, weighted by their shares and in their order.
fn sum_gradients(shards: &mut [Shard], threads: &Threads) {
    let Some((first, others)) = shards.split_first_mut() else { return };
    let share = first.share as f32;
    let length = first.pass.gradients.len();
    let mut rest = &mut first.pass.gradients[..];
    let mut parts = Vec::new();
    for i in 0..threads.count {
        let range = part(length, i, threads.count);
        let (sum, after) = std::mem::take(&mut rest).split_at_mut(range.len());
        parts.push((range, sum));
        rest = after;
    }
    threads.for_each(&mut parts, |_, (range, sum)| {
        sum.iter_mut().for_each(|sum| *sum *= share);
        for shard in &*others {
            let (share, gradients) = (shard.share as f32, &shard.pass.gradients[range.clone()]);
            sum.iter_mut().zip(gradients).for_each(|(sum, gradient)| *sum += share * gradient);
        }
    });
}

/// Replaces the content of `to` by rows of `from`, each with `width` numbers.
fn gather<T: Copy>(rows: &[usize], from: &[T], width: usize, to: &mut Vec<T>) {
    to.clear();
    rows.iter().for_each(|row| to.extend_from_slice(&from[row * width..(row + 1) * width]));
}

/// Generalised advantage estimation (Schulman et al., 2016), (T N,). There is no bootstrapping at the end of an episode.
///
/// ```text
/// d_t = r_t + gamma v_{t+1} - v_t       A_t = d_t + gamma lambda A_{t+1}
/// ```
fn generalised_advantages(segment: &Segment, num_envs: usize, gamma: f64, gae_lambda: f64) -> Vec<f32> {
    let (gamma, decay) = (gamma as f32, (gamma * gae_lambda) as f32);
    let rows = segment.values.len();
    let mut advantages = vec![0.0; rows];
    for row in (0..rows).rev() {
        let (next_value, next_advantage) = if row + num_envs < rows {
            (segment.values[row + num_envs], advantages[row + num_envs])
        } else {
            (segment.last_values[row + num_envs - rows], 0.0)
        };
        let goes_on = if segment.dones[row] { 0.0 } else { 1.0 };
        let difference = segment.rewards[row] + gamma * next_value * goes_on - segment.values[row];
        advantages[row] = difference + decay * goes_on * next_advantage;
    }
    advantages
}

/// Mean and standard deviation, with Bessel's correction as PyTorch's: NaN for a single number.
fn moments(numbers: &[f32]) -> (f64, f64) {
    let count = numbers.len() as f64;
    let mean = numbers.iter().map(|x| f64::from(*x)).sum::<f64>() / count;
    let squares: f64 = numbers.iter().map(|x| (f64::from(*x) - mean).powi(2)).sum();
    (mean, (squares / (count - 1.0)).sqrt())
}

/// What normalises advantages: their mean, and their standard deviation plus 1e-8. A single one stays as it is.
fn scale(advantages: &[f32]) -> (f64, f64) {
    if advantages.len() < 2 {
        return (0.0, 1.0);
    }
    let (mean, deviation) = moments(advantages);
    (mean, deviation + 1e-8)
}

/// What normalises the advantages of a minibatch.
fn scale_of(minibatch: &[usize], num_envs: usize, length: usize, advantages: &[f32]) -> (f32, f32) {
    let of = |first: &usize| advantages[*first..].iter().step_by(num_envs).take(length);
    let (mean, deviation) = scale(&minibatch.iter().flat_map(of).copied().collect::<Vec<f32>>());
    (mean as f32, deviation as f32)
}

fn normalise(advantages: &mut [f32]) {
    let (mean, deviation) = scale(advantages);
    advantages.iter_mut().for_each(|a| *a = ((f64::from(*a) - mean) / deviation) as f32);
}

/// Fraction of the variance of the returns that the values explain; NaN if the returns have no variance.
fn explained_variance(values: &[f32], returns: &[f32]) -> f64 {
    let errors: Vec<f32> = returns.iter().zip(values).map(|(r, v)| r - v).collect();
    let variance = moments(returns).1.powi(2);
    if variance == 0.0 { f64::NAN } else { 1.0 - moments(&errors).1.powi(2) / variance }
}

#[cfg(test)]
mod tests {
    use clap::{Args, Command, FromArgMatches};
    use endless_gym_memory_gym::memory_gym;

    use super::*;
    use crate::environments::Environments;
    use crate::rollout::{Clock, Player, Purpose, generator};

    const ARGUMENTS: &str = "learn MortarMayhem-Grid-v0 --environment.option command_count=[1] --environment.num-envs 8 --ppo.steps 24 \
                             --recurrence.sequence-length 12 --recurrence.hidden-size 16 --recurrence.layers 2 --agent";

    #[test]
    fn whole_sequences_have_the_probabilities_of_acting() {
        for agent in ["gru", "mingru"] {
            let command = Settings::augment_args(Command::new("learn"));
            let arguments = ARGUMENTS.split_whitespace().chain([agent]);
            let settings = Settings::from_arg_matches(&command.get_matches_from(arguments)).unwrap();
            let (threads, environments) =
                (Threads::new(1).unwrap(), Environments::in_process(memory_gym(), &settings).unwrap());
            let (width, choices) = (environments.observation_width(), environments.choices());
            let mut random = generator(1, Purpose::Weights, 0);
            let network = crate::network::new(&settings, width, choices, &mut random);
            let mut player = Player::new(&settings, &network, &threads, environments).unwrap();
            // The second segment starts within episodes.
            for update in 0..2 {
                player.collect(&network, &threads, update, &mut Clock::default()).unwrap();
            }
            let (segment, length) = (&player.segment, settings.sequence_length());
            let targets = Targets { advantages: segment.rewards.clone(), returns: segment.rewards.clone() };
            let mut shard = Shard { sequences: sequences(24, 8, length), ..Shard::default() };
            shard.compute(&network, segment, &targets, (0.0, 1.0), &settings, 0.01);
            let Shard { pass: whole, rows, resets, actions, losses, sequences: firsts, .. } = &shard;

            let mut taken = vec![0.0; actions.len()];
            categorical::log_prob(&whole.logits, &network.spec.choices, actions, &mut taken);
            let of = |all: &[f32]| rows.iter().map(|row| all[*row]).collect::<Vec<f32>>();
            assert_eq!((taken, &whole.values), (of(&segment.log_probs), &of(&segment.values)), "{agent}");
            assert_eq!(losses[4..], [0.0, 0.0]);

            // Episodes start within sequences.
            assert!(resets[firsts.len()..].iter().filter(|reset| **reset).count() > 8);
        }
    }
}
