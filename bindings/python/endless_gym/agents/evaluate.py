"""Playing whole episodes of given seeds with a trained agent, as the paper's evaluation does."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from endless_gym.agents.agent import Agent
from endless_gym.agents.metrics import TASK_PROGRESS, needs_path_length, path_length, task_progress
from endless_gym.specs import spec
from endless_gym.vector import make_vec

#: Seeds that no training has seen, and how often each is played; the agent's actions are drawn, so that episodes differ.
EVALUATION_SEEDS = range(200_000, 200_050)
REPETITIONS = 3


def evaluate(
    agent: Agent,
    seeds: Sequence[int] = EVALUATION_SEEDS,
    repetitions: int = REPETITIONS,
    *,
    num_threads: int | None = None,
    draws: int = 0,
    greedy: bool = False,
    ended: Callable[[int], None] | None = None,
) -> list[dict[str, float]]:
    """Play each seed several times, all episodes at once.

    Args:
        agent: Who plays; its settings name the environment and its reset parameters.
        seeds: Of the episodes.
        repetitions: How often each is played.
        num_threads: Threads that step the environments; `None` for one for each core.
        draws: Seed of the agent's draws.
        greedy: Take the most likely actions instead of drawing them.
        ended: Is told, whenever some of the episodes have ended, how many.

    Returns:
        The final infos of all episodes, with `seed` and in finite environments `task_progress`: `repetitions` times all seeds
        in turn.
    """
    settings, described = agent.settings, spec(agent.settings.env)
    options = settings.options()
    played = [seed for _ in range(repetitions) for seed in seeds]
    memory, generator = agent.initial_memory(len(played)), torch.Generator(agent.device).manual_seed(draws)
    results: list[dict[str, float]] = [{} for _ in played]
    with make_vec(
        settings.env,
        len(played),
        num_threads,
        seeds=played,
        options=options,
        autoreset="same_step",
        observation=settings.environment.observation,
    ) as envs:
        observation, _ = envs.reset()
        paths = [0] * len(played)
        if needs_path_length(described.id):
            paths = [path_length(envs.ground_truth_view(env)) for env in range(len(played))]
        while not all(results):
            acted = agent.act(observation, memory, generator, greedy)
            observation, _, terminated, truncated, info = envs.step(acted.action.cpu().numpy())
            done = terminated | truncated
            memory.forget(done)
            before = sum(map(bool, results))
            for env in np.flatnonzero(done):
                # An environment that is done goes on with another episode, which does not count.
                if not results[env]:
                    final = info["final_info"]
                    names = [name for name in final if not name.startswith("_") and name != "ground_truth"]
                    result = {name: float(final[name][env]) for name in names}
                    progress = task_progress(described, options, result, paths[env])
                    results[env] = result | {"seed": float(played[env])}
                    if progress is not None:
                        results[env][TASK_PROGRESS] = progress
            now = sum(map(bool, results))
            if ended is not None and now > before:
                ended(now - before)
    return results


def mean(results: Sequence[dict[str, float]], name: str = "reward") -> float:
    """The mean of one entry of the infos."""
    return sum(result[name] for result in results) / len(results)
