"""The spaces, states, observations, rewards and ends of POPGym's environments.

As a program, it prints those of the original, `popgym`, as JSON.

`tests/reference/popgym/states.json.gz` has what it printed for popgym 1.0.7 and the seed 20261128.
"""

from __future__ import annotations

import json
import sys
import zlib
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np


def checksum(state: Any) -> int:
    """A checksum of the types and the numbers of a state."""
    if isinstance(state, tuple):
        return zlib.crc32(repr([checksum(part) for part in state]).encode())
    array = np.asarray(state)
    return zlib.crc32(f"{type(state).__name__} {array.dtype} {array.shape} {array.tolist()}".encode())


def states(env: Any, seed: int) -> dict[str, Any]:
    """Checksums of the spaces and of all steps of two episodes, and whether the best policy needs the previous action."""
    random = np.random.default_rng(seed)
    found = []
    for episode_seed in (seed, None):
        observation, _ = env.reset(seed=episode_seed)
        is_running = True
        found.append(checksum((env.get_state(), observation)))
        while is_running:
            space = env.action_space
            if isinstance(space, gymnasium.spaces.Discrete):
                action: Any = int(random.integers(space.n))
            elif isinstance(space, gymnasium.spaces.MultiDiscrete):
                action = random.integers(space.nvec)
            else:
                action = random.uniform(space.low, space.high).astype(np.float32)
            observation, reward, terminated, truncated, _ = env.step(action)
            is_running = not (terminated or truncated)
            found.append(checksum((env.get_state(), observation, reward, bool(terminated), bool(truncated))))
    # The text of a space leaves out long vectors.
    return {
        "spaces": [checksum(repr(flat(of))) for of in (env.observation_space, env.action_space, env.state_space)],
        "needs_action": env.obs_requires_prev_action,
        "states": found,
    }


def flat(space: gymnasium.Space[Any]) -> list[Any]:
    """Kind, shape, dtype and numbers of a space."""
    if isinstance(space, gymnasium.spaces.Tuple):
        return [flat(part) for part in space.spaces]
    numbers = [np.ravel(getattr(space, name, [])).tolist() for name in ("n", "nvec", "low", "high")]
    return [type(space).__name__, space.shape, str(space.dtype), numbers]


if __name__ == "__main__":
    reference = Path(__file__).parents[3] / "tests/reference/popgym"
    sys.path.insert(0, str(reference))
    from original import IDS, made

    ids = [*IDS, *json.loads((reference / "arguments.json").read_text())]
    print(json.dumps({id: states(made(id), int(sys.argv[1])) for id in ids}, separators=(",", ":")))
