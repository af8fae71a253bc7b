"""Evaluation of a trained agent on complete episodes of given seeds, as in the paper."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from endless_gym.specs import spec
from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.environments import wrappers
from endless_gym_agents.settings import Settings

#: The paper's protocol: seeds that training never uses, and episodes per seed. Actions are sampled, so the episodes of a seed
#: differ.
EVALUATION_SEEDS = range(200_000, 200_050)
REPETITIONS = 3


def evaluate(
    agent: Agent,
    seeds: Sequence[int] = EVALUATION_SEEDS,
    repetitions: int = REPETITIONS,
    *,
    settings: Settings | None = None,
    num_threads: int | None = None,
    action_seed: int = 0,
    greedy: bool = False,
    ended: Callable[[int], None] | None = None,
) -> list[dict[str, float]]:
    """Play several episodes of each seed, all in parallel.

    Args:
        agent: The agent.
        seeds: Seeds of the episodes.
        repetitions: Episodes per seed.
        settings: Settings of the environments; `None` for the agent's, which name its environment and reset parameters.
        num_threads: Threads that step the environments; `None` for one per core.
        action_seed: Seed of the generator that samples the actions.
        greedy: Take the most likely actions instead of sampling.
        ended: Called with the number of episodes that have ended, after each step in which some have.

    Returns:
        The final infos of all episodes, each with `seed`; all seeds in order, repeated `repetitions` times.
    """
    settings = settings or agent.settings
    env_spec = spec(settings.env)
    episode_seeds = [seed for _ in range(repetitions) for seed in seeds]
    num_envs = len(episode_seeds)
    memory, generator = agent.initial_memory(num_envs), torch.Generator(agent.device).manual_seed(action_seed)
    results: list[dict[str, float]] = [{} for _ in episode_seeds]
    with wrappers.make(settings, num_envs, num_threads, seeds=episode_seeds) as envs:
        observation, _ = envs.reset()
        while not all(results):
            output = agent.act(observation, memory, generator, greedy)
            observation, _, terminated, truncated, info = envs.step(
                env_spec.batched_actions(output.action.cpu().numpy())
            )
            done = terminated | truncated
            memory.reset(done)
            # Autoreset starts further episodes, which are ignored.
            first = [env for env in np.flatnonzero(done) if not results[env]]
            for env in first:
                final = info["final_info"]
                names = [name for name in final if not name.startswith("_") and final[name].ndim == 1]
                result = {name: float(final[name][env]) for name in names}
                results[env] = result | {"seed": float(episode_seeds[env])}
            if ended is not None and first:
                ended(len(first))
    return results


def mean(results: Sequence[dict[str, float]], name: str = "reward") -> float:
    """Mean of the entry `name` over the episodes that `evaluate` returned."""
    return sum(result[name] for result in results) / len(results)
