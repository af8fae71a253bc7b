"""Measure the steps per second of all environments on this machine."""

from __future__ import annotations

import argparse
import json
import platform
import time

import numpy as np

import endless_gym
from endless_gym import EndlessVectorEnv


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m endless_gym", description=__doc__)
    parser.add_argument("--num-envs", type=int, default=256, help="number of environments (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=0.5, help="seconds of each measurement (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print JSON (default: a table)")
    arguments = parser.parse_args()
    rows = []
    if not arguments.json:
        print(f"endless-gym {endless_gym.__version__}, Python {platform.python_version()}, {platform.platform()}")
        print(f"steps per second, {arguments.num_envs} environments\n")
        print(f"{'environment':30}{'in process':>12}{'service':>12}  task")
    for spec in endless_gym.all_specs().values():
        with endless_gym.make_vec(spec.id, arguments.num_envs) as envs:
            in_process = measure(envs, arguments.seconds)
        with endless_gym.serve(spec.id, arguments.num_envs) as envs:
            service = measure(envs, arguments.seconds)
        rows.append({"environment": spec.id, "in_process": round(in_process), "service": round(service)})
        if not arguments.json:
            print(f"{spec.id:30}{in_process:12,.0f}{service:12,.0f}  {spec.summary}", flush=True)
    if arguments.json:
        print(
            json.dumps({"version": endless_gym.__version__, "num_envs": arguments.num_envs, "steps_per_second": rows})
        )


def measure(envs: EndlessVectorEnv, seconds: float) -> float:
    """Steps per second with random actions, after a short warm-up."""
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [np.asarray(envs.action_space.sample()) for _ in range(64)]
    for action in actions[:20]:
        envs.step(action)
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        envs.step(actions[steps % len(actions)])
        steps += 1
    return steps * envs.num_envs / (time.perf_counter() - start)


if __name__ == "__main__":
    main()
