"""Simulation speed as the paper measures it: one environment, a constant action, resets included."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from endless_gym.env import Env
from endless_gym_agents.common import atomic, command


def measure(env_id: str, episodes: int) -> list[float]:
    """Steps per second of each episode, reset included, with action 0 throughout.

    Args:
        env_id: Environment id.
        episodes: Number of episodes, with the seeds 0, 1 and so on.
    """
    env: Env = Env(env_id)
    action: Any = np.zeros_like(env.action_space.sample())
    rates = []
    for seed in range(episodes):
        start, steps, done = time.perf_counter(), 0, False
        env.reset(seed=seed)
        while not done:
            _, _, terminated, truncated, _ = env.step(action)
            steps, done = steps + 1, terminated or truncated
        rates.append(steps / (time.perf_counter() - start))
    env.close()
    return rates


def main() -> int:
    """Entry point of the measurement; returns the exit status."""
    parser = argparse.ArgumentParser(prog="endless-speed", description=__doc__)
    parser.add_argument("--env", required=True)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--json", required=True)
    given = parser.parse_args()

    def execute() -> None:
        rates = measure(given.env, given.episodes)
        result = {"mean": float(np.mean(rates)), "std": float(np.std(rates)), "episodes": len(rates)}
        result["load_average"] = os.getloadavg()[0]
        Path(given.json).parent.mkdir(parents=True, exist_ok=True)
        atomic.write(given.json, json.dumps(result) + "\n")

    return command.run("endless-speed", execute)


if __name__ == "__main__":
    sys.exit(main())
