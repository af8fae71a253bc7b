"""Generalised advantage estimation, and the loss terms of PPO and its auxiliary tasks.

Tensors are float32 unless stated otherwise. T is the number of steps in a segment, N the number of environments, and M the
number of steps in a minibatch. Every loss is a scalar, the mean over the minibatch.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def generalised_advantages(
    rewards: Tensor, values: Tensor, dones: Tensor, last_value: Tensor, gamma: float, gae_lambda: float
) -> Tensor:
    """Generalised advantage estimation (Schulman et al., 2016).

    There is no bootstrapping at the end of an episode; `PPO.bootstrap_truncated` makes it a part of the rewards.

    Args:
        rewards: Reward of step `t`, (T, N).
        values: Value estimate of the observation before step `t`, (T, N).
        dones: Whether step `t` ended its episode, bool (T, N).
        last_value: Bootstrap value: the value estimate of the observation after the last step, (N,).
        gamma: Discount factor.
        gae_lambda: Lambda, the trade-off between bias (0) and variance (1).

    Returns:
        The advantages, (T, N). The returns, targets of the value function, are the advantages plus `values`.
    """
    not_done = (~dones).to(rewards.dtype)
    advantages = rewards + gamma * torch.cat([values[1:], last_value.unsqueeze(0)]) * not_done - values  # the TD errors
    # `advantages` sums `steps` decayed TD errors from each step on; `decay` is the decay over that many steps. Each iteration
    # doubles `steps` until the sums reach the end, which takes 3 * log2(T) operations instead of T.
    decay, steps = gamma * gae_lambda * not_done, 1
    while steps < len(advantages):
        longer = torch.addcmul(advantages[:-steps], decay[:-1], advantages[steps:])
        advantages = torch.cat([longer, advantages[-steps:]])
        decay, steps = decay[:-steps] * decay[steps:], 2 * steps
    return advantages


def normalised(advantages: Tensor, reference: Tensor | None = None) -> Tensor:
    """Scale advantages of any shape so that `reference`, by default `advantages`, has mean 0 and standard deviation 1.

    A reference of one step has no standard deviation; the advantages then stay as they are.
    """
    reference = advantages if reference is None else reference
    if reference.numel() < 2:
        return advantages
    return (advantages - reference.mean()) / (reference.std() + 1e-8)


def policy_loss(log_probs: Tensor, old_log_probs: Tensor, advantages: Tensor, clip_range: float) -> Tensor:
    """The negated clipped surrogate objective of PPO.

    The probability ratio is computed and clipped for each branch of the action separately; the loss is the mean over all
    branches.

    Args:
        log_probs: Log-probabilities of the taken actions under the current policy, (M, branches).
        old_log_probs: Log-probabilities under the policy that collected the rollout, (M, branches).
        advantages: (M,).
        clip_range: Epsilon: the ratio is clipped to the range 1 - epsilon to 1 + epsilon.
    """
    ratio = (log_probs - old_log_probs).exp()
    weight = advantages.unsqueeze(1)
    return -torch.min(ratio * weight, ratio.clamp(1.0 - clip_range, 1.0 + clip_range) * weight).mean()


def value_loss(values: Tensor, old_values: Tensor, returns: Tensor, clip_range: float) -> Tensor:
    """The clipped value loss of PPO: the larger of the squared errors of the value and of the clipped value.

    Args:
        values: Current value estimates, (M,).
        old_values: Value estimates while the rollout was collected, (M,).
        returns: Targets, (M,).
        clip_range: Largest difference between the clipped value and the old one.
    """
    clipped = old_values + (values - old_values).clamp(-clip_range, clip_range)
    return torch.max((values - returns).square(), (clipped - returns).square()).mean()


def reconstruction_loss(logits: Tensor, frames: Tensor) -> Tensor:
    """Binary cross-entropy between the sigmoid of the logits and the frames scaled to 0 to 1.

    Args:
        logits: Logits of the reconstruction, (M, channels, 84, 84).
        frames: Observed frames, uint8 (M, 84, 84, channels).
    """
    target = frames.permute(0, 3, 1, 2).to(logits.dtype) / 255.0
    return functional.binary_cross_entropy_with_logits(logits, target)


def ground_truth_loss(estimates: Tensor, truth: Tensor) -> Tensor:
    """Mean squared error between the estimated and the actual ground truth, (M, entries) each."""
    return (estimates - truth).square().mean()


def explained_variance(values: Tensor, returns: Tensor) -> Tensor:
    """Fraction of the variance of `returns` that `values`, of the same shape, explain; NaN if the returns have no variance."""
    if returns.numel() < 2:
        return returns.new_tensor(float("nan"))
    variance = returns.var()
    return (1.0 - (returns - values).var() / variance).masked_fill(variance == 0, float("nan"))
