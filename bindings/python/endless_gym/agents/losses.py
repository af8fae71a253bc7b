"""The paper's equations: advantages, and the losses that are summed up.

All functions work on float32 tensors and return means over the steps they are given.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def generalised_advantages(
    rewards: Tensor, values: Tensor, dones: Tensor, last_value: Tensor, gamma: float, gae_lambda: float
) -> Tensor:
    """Generalised advantage estimation.

    An episode that ends, be it by the step limit, has no value after its last step.

    Args:
        rewards: What step `t` earned, (T, N).
        values: The value estimated before step `t`, (T, N).
        dones: Whether step `t` ended its episode, bool (T, N).
        last_value: The value estimated after the last step, (N,).
        gamma: Discount factor.
        gae_lambda: Weight of longer returns.

    Returns:
        The advantages, (T, N); returns are these plus `values`.
    """
    advantages = torch.empty_like(rewards)
    following, advantage = last_value, torch.zeros_like(last_value)
    goes_on = (~dones).to(rewards.dtype)
    for t in range(rewards.shape[0] - 1, -1, -1):
        error = rewards[t] + gamma * following * goes_on[t] - values[t]
        advantage = error + gamma * gae_lambda * goes_on[t] * advantage
        advantages[t] = advantage
        following = values[t]
    return advantages


def normalised(advantages: Tensor) -> Tensor:
    """Advantages with mean 0 and standard deviation 1."""
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def policy_loss(log_probs: Tensor, old_log_probs: Tensor, advantages: Tensor, clip_range: float) -> Tensor:
    """PPO's clipped surrogate, negated; the ratio is clipped for each branch of the action, and all are averaged.

    Args:
        log_probs: Of the actions taken, under the current policy, (M, branches).
        old_log_probs: Under the policy that took them, (M, branches).
        advantages: (M,).
        clip_range: How far the ratio may leave 1 and still be rewarded.
    """
    ratio = (log_probs - old_log_probs).exp()
    weight = advantages.unsqueeze(1)
    return -torch.min(ratio * weight, ratio.clamp(1.0 - clip_range, 1.0 + clip_range) * weight).mean()


def value_loss(values: Tensor, old_values: Tensor, returns: Tensor, clip_range: float) -> Tensor:
    """The larger of the squared errors of the value and of the value clipped to the old one's neighbourhood; all (M,)."""
    clipped = old_values + (values - old_values).clamp(-clip_range, clip_range)
    return torch.max((values - returns).square(), (clipped - returns).square()).mean()


def reconstruction_loss(logits: Tensor, frames: Tensor) -> Tensor:
    """Binary cross entropy between the sigmoid of `logits` and the frames.

    Args:
        logits: (M, channels, 84, 84).
        frames: uint8 (M, 84, 84, channels).
    """
    target = frames.permute(0, 3, 1, 2).to(logits.dtype) / 255.0
    return functional.binary_cross_entropy_with_logits(logits, target)


def ground_truth_loss(estimates: Tensor, truth: Tensor) -> Tensor:
    """Mean squared error of the estimated ground truth, (M, k)."""
    return (estimates - truth).square().mean()


def explained_variance(values: Tensor, returns: Tensor) -> float:
    """Share of the returns' variance that the values explain: 1 is all, 0 is none; NaN if there is no variance."""
    variance = returns.var()
    return float("nan") if variance == 0 else float(1.0 - (returns - values).var() / variance)
