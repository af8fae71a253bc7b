"""When a task counts as learnt, so that a run of the preset `quick` can stop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from endless_gym.specs import Spec
from endless_gym_agents.metrics import counts_failures, is_finite

#: Fraction of the best possible result at which a task counts as learnt.
SHARE = 0.9


def learnt(spec: Spec, options: Mapping[str, Any], means: Mapping[str, float]) -> str | None:
    """Why the task counts as learnt, for a message; `None` if it does not.

    Always `None` in endless environments, and in Mortar Mayhem where failures are rewarded.

    Args:
        spec: Specification of the environment.
        options: Reset parameters that differ from the defaults.
        means: Means over the last episodes by name, `episode/reward` and `episode/NAME` for each final info.
    """
    if not is_finite(spec.id):
        return None
    name, best = "success", 1.0
    if counts_failures(spec.id):
        # The infos count a failed last command as executed; the reward does not.
        parameters = {**spec.reset_parameters, **options}
        if parameters["reward_command_failure"] > 0:
            return None  # an agent that fails may reach the reward, too
        counts = [int(count) for count in parameters["command_count"]]
        commands = sum(counts) / len(counts)
        name, best = "reward", commands * parameters["reward_command_success"] + parameters["reward_episode_success"]
    reached = means.get(f"episode/{name}")
    if reached is None or best <= 0 or reached < SHARE * best:
        return None
    return f"the last episodes have a mean {name} of {reached:.3f}, and at most {best:.3f} is possible"
