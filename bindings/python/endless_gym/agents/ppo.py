"""Learning: proximal policy optimisation on one segment."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from endless_gym.agents import losses
from endless_gym.agents.agent import Agent
from endless_gym.agents.encoders import FRAME
from endless_gym.agents.memory import Plan, State
from endless_gym.agents.rollout import Segment
from endless_gym.agents.settings import PPO


def decayed(first: float, final: float, update: int, decay_updates: int) -> float:
    """Linear from `first` at update 0 to `final` at `decay_updates`, and `final` from then on."""
    return final + (first - final) * max(0.0, 1.0 - update / decay_updates)


def minibatch_loss(
    agent: Agent,
    segment: Segment,
    plan: Plan,
    advantages: Tensor,
    returns: Tensor,
    settings: PPO,
    entropy_coefficient: float,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The sum of all losses over one minibatch.

    Args:
        agent: Whose weights are to be optimised.
        segment: Flat, see `Segment.flat`.
        plan: Which steps the minibatch has.
        advantages: Of all steps of the segment, (T * N,).
        returns: Of all steps of the segment, (T * N,).
        settings: Coefficients and clip range.
        entropy_coefficient: Weight of the entropy bonus in this update.

    Returns:
        The loss, and its parts and some measures by name, without gradients.
    """
    steps = plan.steps
    observation = {key: part[steps] for key, part in segment.observation.items()}
    evaluated = agent.evaluate(observation, plan)
    log_prob, old_log_prob = evaluated.log_prob(segment.action[steps]), segment.log_prob[steps]
    advantage = advantages[steps]
    if settings.advantage_normalisation == "minibatch":
        advantage = losses.normalised(advantage)
    policy = losses.policy_loss(log_prob, old_log_prob, advantage, settings.clip_range)
    value = losses.value_loss(evaluated.value, segment.value[steps], returns[steps], settings.clip_range)
    entropy = evaluated.entropy().mean()
    loss = policy + settings.value_coefficient * value - entropy_coefficient * entropy
    parts = {"policy_loss": policy, "value_loss": value, "entropy": entropy}
    if evaluated.frame is not None:
        parts["reconstruction_loss"] = losses.reconstruction_loss(evaluated.frame, observation[FRAME])
        loss = loss + settings.reconstruction_coefficient * parts["reconstruction_loss"]
    if evaluated.ground_truth is not None and segment.ground_truth is not None:
        parts["ground_truth_loss"] = losses.ground_truth_loss(evaluated.ground_truth, segment.ground_truth[steps])
        loss = loss + settings.ground_truth_coefficient * parts["ground_truth_loss"]
    with torch.no_grad():
        log_ratio = log_prob - old_log_prob
        # Schulman's estimator of the divergence: unbiased, and never negative.
        parts["kl_divergence"] = (log_ratio.exp() - 1.0 - log_ratio).mean()
        parts["clip_fraction"] = ((log_ratio.exp() - 1.0).abs() > settings.clip_range).float().mean()
    return loss, {name: part.detach() for name, part in {"loss": loss, **parts}.items()}


def learn(
    agent: Agent,
    optimizer: torch.optim.Optimizer,
    segment: Segment,
    states: Sequence[State],
    update: int,
    settings: PPO,
    generator: torch.Generator,
) -> dict[str, float]:
    """Optimise the agent on a segment.

    Args:
        agent: Whose weights are optimised.
        optimizer: Of its weights.
        segment: What was played.
        states: The memory's states of each group, after the segment.
        update: Number of this update, from 0; learning rate and entropy coefficient decay with it.
        settings: Of PPO.
        generator: Of the division into minibatches, on the CPU.

    Returns:
        The means of all losses, and what they were weighted with.
    """
    learning_rate = decayed(settings.learning_rate, settings.final_learning_rate, update, settings.decay_updates)
    entropy_coefficient = decayed(
        settings.entropy_coefficient, settings.final_entropy_coefficient, update, settings.decay_updates
    )
    for group in optimizer.param_groups:
        group["lr"] = learning_rate
    advantages = losses.generalised_advantages(
        segment.reward, segment.value, segment.done, segment.last_value, settings.gamma, settings.gae_lambda
    )
    returns = (advantages + segment.value).flatten()
    advantages = advantages.flatten()
    measures = {
        "learning_rate": learning_rate,
        "entropy_coefficient": entropy_coefficient,
        "value": float(segment.value.mean()),
        "advantage": float(advantages.mean()),
        "explained_variance": losses.explained_variance(segment.value.flatten(), returns),
    }
    if settings.advantage_normalisation == "batch":
        advantages = losses.normalised(advantages)
    first, flat = segment.first.cpu(), segment.flat()
    sums: dict[str, Tensor] = defaultdict(lambda: torch.zeros((), device=agent.device))
    count = 0
    for _ in range(settings.epochs):
        for plan in agent.memory.plan(states, first, settings.minibatches, generator):
            loss, parts = minibatch_loss(agent, flat, plan, advantages, returns, settings, entropy_coefficient)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            parts["gradient_norm"] = nn.utils.clip_grad_norm_(agent.parameters(), settings.max_gradient_norm)
            optimizer.step()
            for name, part in parts.items():
                sums[name] += part
            count += 1
    return measures | {name: float(total / count) for name, total in sums.items()}
