"""Measure an EnvPool environment for `comparison.py`, for scale. EnvPool has no Memory Gym environments.

Arguments: environment id, number of environments, seconds. Prints steps per second.
"""

import sys
import time
import warnings

warnings.filterwarnings("ignore")

import envpool  # noqa: E402
import numpy as np  # noqa: E402


def main() -> None:
    """Measure and print."""
    id, num_envs, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    envs = envpool.make(id, env_type="gymnasium", num_envs=num_envs)
    envs.reset()
    actions = np.random.default_rng(0).integers(0, envs.action_space.n, (251, num_envs))
    batches, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        envs.step(actions[batches % len(actions)])
        batches += 1
    print(batches * num_envs / (time.perf_counter() - start))


if __name__ == "__main__":
    main()
