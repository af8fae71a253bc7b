"""Proximal policy optimisation (Schulman et al., 2017) on one segment."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from endless_gym_agents.agent.agent import Agent, AgentOutput
from endless_gym_agents.agent.encoders import FRAME
from endless_gym_agents.environments.ranks import Ranks
from endless_gym_agents.memories.memory import MemoryState, Minibatch
from endless_gym_agents.settings import PPO
from endless_gym_agents.training import losses
from endless_gym_agents.training.rollout import Segment


class Diverged(ValueError):
    """The loss, the gradient or the weights are no longer finite."""


def linear_decay(initial: float, final: float, update: int, decay_updates: int) -> float:
    """Interpolate linearly from `initial` at update 0 to `final` at update `decay_updates`, and return `final` after that."""
    return final + (initial - final) * max(0.0, 1.0 - update / decay_updates)


def make_optimizer(agent: Agent, learning_rate: float) -> torch.optim.AdamW:
    """AdamW with PyTorch's default coefficients, fused where PyTorch supports it.

    `PPO.weight_decay` says which weights decay. A memory sets attributes of parameters: with `_no_weight_decay = True` one never
    decays, and `_learning_rate_factor = x` multiplies its learning rate.
    """
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    for name, parameter in agent.named_parameters():
        is_matrix = parameter.dim() > 1 and not name.endswith("bias")
        decays = agent.settings.ppo.weight_decay == "all" or is_matrix
        decay = 0.01 if decays and not getattr(parameter, "_no_weight_decay", False) else 0.0
        groups.setdefault((decay, learning_rate_factor(parameter)), []).append(parameter)
    return torch.optim.AdamW(
        [{"params": each, "weight_decay": decay} for (decay, _), each in groups.items()],
        lr=learning_rate,
        fused=agent.device.type in ("cpu", "cuda"),
    )


def learning_rate_factor(parameter: nn.Parameter) -> float:
    """The factor of a parameter's learning rate; the same for all of a group of `make_optimizer`."""
    return getattr(parameter, "_learning_rate_factor", 1.0)


def minibatch_loss(
    agent: Agent,
    segment: Segment,
    minibatch: Minibatch,
    advantages: Tensor,
    returns: Tensor,
    settings: PPO,
    entropy_coefficient: float,
    reference: Tensor | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The total loss of one minibatch.

    Args:
        agent: The agent to optimise.
        segment: The flattened segment; see `Segment.flat`.
        minibatch: The steps of the minibatch, at least one.
        advantages: Advantages of all steps of the segment, float32 (T * N,).
        returns: Returns of all steps of the segment, float32 (T * N,).
        settings: Coefficients and clip range.
        entropy_coefficient: Weight of the entropy bonus in this update.
        reference: With normalisation per minibatch, the advantages of the minibatch's steps on all ranks, float32 (steps,), whose
            mean and standard deviation are used; `None` for those of `minibatch`.

    Returns:
        The loss, a scalar with gradient; and scalars without gradient by name: the loss and its terms, the approximate KL
        divergence from the policy that collected the rollout, and the fraction of clipped probability ratios.
    """
    indices = minibatch.indices
    observation, rows = segment.distinct(indices)
    output: AgentOutput = agent(observation, minibatch, rows)

    def chosen(tensor: Tensor) -> Tensor:
        return tensor.index_select(0, indices)

    log_prob, old_log_prob = output.log_prob(chosen(segment.action)), chosen(segment.log_prob)
    advantage = chosen(advantages)
    if settings.advantage_normalisation == "minibatch":
        advantage = losses.normalised(advantage, reference)
    policy = losses.policy_loss(log_prob, old_log_prob, advantage, settings.clip_range)
    value = losses.value_loss(output.value, chosen(segment.value), chosen(returns), settings.clip_range)
    entropy = output.entropy().mean()
    loss = policy + settings.value_coefficient * value - entropy_coefficient * entropy
    parts = {"policy_loss": policy, "value_loss": value, "entropy": entropy}
    if output.frame is not None:
        frames = chosen(segment.observation[FRAME])
        parts["reconstruction_loss"] = losses.reconstruction_loss(output.frame, frames)
        loss = loss + settings.reconstruction_coefficient * parts["reconstruction_loss"]
    if output.ground_truth is not None and segment.ground_truth is not None:
        parts["ground_truth_loss"] = losses.ground_truth_loss(output.ground_truth, chosen(segment.ground_truth))
        loss = loss + settings.ground_truth_coefficient * parts["ground_truth_loss"]
    with torch.no_grad():
        log_ratio = log_prob - old_log_prob
        # Schulman's k3 estimator of the KL divergence: unbiased and never negative (joschu.net/blog/kl-approx.html).
        parts["kl_divergence"] = (log_ratio.exp() - 1.0 - log_ratio).mean()
        parts["clip_fraction"] = ((log_ratio.exp() - 1.0).abs() > settings.clip_range).float().mean()
    return loss, {name: part.detach() for name, part in {"loss": loss, **parts}.items()}


def learn(
    agent: Agent,
    optimizer: torch.optim.Optimizer,
    segment: Segment,
    states: Sequence[MemoryState],
    update: int,
    settings: PPO,
    generator: torch.Generator,
    ranks: Ranks | None = None,
) -> dict[str, float]:
    """Optimise the agent on one segment.

    Args:
        agent: The agent to optimise.
        optimizer: Optimizer of the agent's parameters.
        segment: The collected segment.
        states: The memory state of each group of environments after the segment.
        update: Number of this update, counted from 0; learning rate and entropy coefficient decay with it.
        settings: Hyperparameters.
        generator: Generator that shuffles the minibatches, on the CPU; in the same state on every rank.
        ranks: The ranks of the run, each with a segment of its own environments; `None` for this process alone.

    Returns:
        Metrics of the update by name: losses, gradient norm before clipping and so on, averaged over all minibatches; norm of
        the weights after the update, learning rate, entropy coefficient, mean value, mean advantage and explained variance.

    Raises:
        Diverged: The loss or the gradient norm of a minibatch, or the norm of the weights after the update, is not finite. The
            weights are then useless; on several ranks, every rank raises it.
    """
    learning_rate = linear_decay(settings.learning_rate, settings.final_learning_rate, update, settings.decay_updates)
    entropy_coefficient = linear_decay(
        settings.entropy_coefficient, settings.final_entropy_coefficient, update, settings.decay_updates
    )
    for group in optimizer.param_groups:
        group["lr"] = learning_rate * learning_rate_factor(group["params"][0])
    ranks = ranks or Ranks()
    own_advantages = losses.generalised_advantages(
        segment.reward, segment.value, segment.done, segment.last_value, settings.gamma, settings.gae_lambda
    )
    returns, flat = (own_advantages + segment.value).flatten(), segment.flat()
    # Gather a few numbers per step, so that every rank has those of all environments.
    reset_mask, values = ranks.columns(segment.reset_mask), ranks.columns(segment.value).flatten()
    advantages = ranks.columns(own_advantages).flatten()
    own = ranks.share(reset_mask.shape[1])
    metrics = {
        "value": values.mean(),
        "advantage": advantages.mean(),
        "explained_variance": losses.explained_variance(values, advantages + values),
    }
    own_advantages = own_advantages.flatten()
    if settings.advantage_normalisation == "batch":
        own_advantages = losses.normalised(own_advantages, advantages)
    sums: dict[str, Tensor] = defaultdict(lambda: torch.zeros((), device=agent.device))
    minibatches = agent.memory.minibatches(states, reset_mask, settings.minibatches, generator, own, settings.epochs)
    for minibatch in minibatches:
        optimizer.zero_grad(set_to_none=True)
        parts: dict[str, Tensor] = {}
        if len(minibatch.indices):
            is_minibatch = settings.advantage_normalisation == "minibatch"
            reference = advantages.index_select(0, minibatch.everywhere) if is_minibatch else None
            loss, parts = minibatch_loss(
                agent, flat, minibatch, own_advantages, returns, settings, entropy_coefficient, reference
            )
            loss.backward()
        share = len(minibatch.indices) / len(minibatch.everywhere)
        add_gradients(agent, ranks, share)
        norm = nn.utils.clip_grad_norm_(agent.parameters(), settings.max_gradient_norm)
        optimizer.step()
        for name, part in parts.items():
            sums[name].add_(part, alpha=share)
        sums["gradient_norm"].add_(norm, alpha=1.0 / ranks.size)
    ranks.add(sums[name] for name in sorted(sums))
    metrics |= {name: total / len(minibatches) for name, total in sums.items()}
    metrics["weight_norm"] = torch.stack(torch._foreach_norm([part.detach() for part in agent.parameters()])).norm()
    # One copy to the host for all metrics.
    numbers = dict(zip(metrics, torch.stack(list(metrics.values())).cpu().tolist(), strict=True))
    for name in ("loss", "gradient_norm", "weight_norm"):
        if not math.isfinite(numbers[name]):
            raise Diverged(
                f"update {update + 1} diverged: its {name} is {numbers[name]}; try a smaller --ppo.learning-rate (now "
                f"{learning_rate:g}) or --ppo.max-gradient-norm (now {settings.max_gradient_norm:g}), or --no-bf16"
            )
    return {"learning_rate": learning_rate, "entropy_coefficient": entropy_coefficient} | numbers


def add_gradients(agent: Agent, ranks: Ranks, share: float) -> None:
    """Sum the gradients over all ranks, each weighted by the rank's `share` of the minibatch's steps."""
    if ranks.size == 1:
        return
    gradients = []
    for parameter in agent.parameters():
        if parameter.grad is None:
            # This rank has no steps in the minibatch.
            parameter.grad = torch.zeros_like(parameter)
        gradients.append(parameter.grad.mul_(share))
    ranks.add(gradients)
