"""Measure the original for `comparison.py`, which starts this script.

Each line of stdin is a JSON object that describes one measurement: `kind`, `id`, `num_envs`, `seconds`. Each line of stdout is
the result in steps per second.
"""

import json
import multiprocessing
import os
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

warnings.filterwarnings("ignore")
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"
# Libraries print to stdout, even in forked processes. Redirect their output to stderr.
answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)

import gymnasium  # noqa: E402
import memory_gym  # noqa: E402, F401
import numpy as np  # noqa: E402
from stable_baselines3.common.vec_env import SubprocVecEnv  # noqa: E402


def rate(step: Callable[[int], Any], num_envs: int, seconds: float) -> float:
    """Steps per second, after ten warm-up steps."""
    for number in range(10):
        step(number)
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        step(steps)
        steps += 1
    return steps * num_envs / (time.perf_counter() - start)


def single(id: str, num_envs: int, seconds: float) -> float:
    """Steps per second of one environment from `gymnasium.make`."""
    env = gymnasium.make(id)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(1009)]
    env.reset(seed=0)

    def step(number: int) -> None:
        if env.step(actions[number % len(actions)])[2]:
            env.reset()

    result = rate(step, 1, seconds)
    env.close()
    return result


def vector(kind: str, id: str, num_envs: int, seconds: float) -> float:
    """Steps per second of a vector environment of Gymnasium or Stable-Baselines3."""
    makers = [lambda: gymnasium.make(id, disable_env_checker=True)] * num_envs
    if kind == "SyncVectorEnv":
        envs = gymnasium.vector.SyncVectorEnv(makers)
    elif kind == "AsyncVectorEnv":
        envs = gymnasium.vector.AsyncVectorEnv(makers, shared_memory=True)
    else:
        envs = SubprocVecEnv(makers, start_method="fork")
    space = gymnasium.vector.utils.batch_space(makers[0]().action_space, num_envs)
    space.seed(0)
    actions = [np.asarray(space.sample()) for _ in range(251)]
    envs.reset()
    result = rate(lambda number: envs.step(actions[number % len(actions)]), num_envs, seconds)
    envs.close()
    return result


def independent(id: str, num_envs: int, seconds: float) -> float:
    """Total steps per second of one process per environment without communication: an upper bound for vector environments."""
    context = multiprocessing.get_context("fork")
    barrier, results = context.Barrier(num_envs), context.SimpleQueue()

    def play() -> None:
        barrier.wait()
        results.put(single(id, 1, seconds))

    processes = [context.Process(target=play) for _ in range(num_envs)]
    for process in processes:
        process.start()
    total = sum(results.get() for _ in processes)
    for process in processes:
        process.join()
    return total


def main() -> None:
    """Measure until stdin ends."""
    for line in sys.stdin:
        asked = json.loads(line)
        kind, arguments = asked["kind"], (asked["id"], asked["num_envs"], asked["seconds"])
        others = {"single": single, "independent": independent}
        result = others[kind](*arguments) if kind in others else vector(kind, *arguments)
        print(result, file=answers, flush=True)


if __name__ == "__main__":
    main()
