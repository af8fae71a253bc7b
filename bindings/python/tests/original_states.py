"""The Markov states of POPGym's environments. As a program, it prints those of the original, `popgym`, as JSON.

`tests/reference/popgym/states.json.gz` has what it printed for popgym 1.0.7 and the seed 20261128.
"""

from __future__ import annotations

import json
import sys
import zlib
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
    """The space of the states, whether the best policy needs the previous action, and checksums of the states of two episodes."""
    random = np.random.default_rng(seed)
    found = []
    for episode_seed in (seed, None):
        env.reset(seed=episode_seed)
        is_running = True
        found.append(checksum(env.get_state()))
        while is_running:
            space = env.action_space
            if isinstance(space, gymnasium.spaces.Discrete):
                action: Any = int(random.integers(space.n))
            elif isinstance(space, gymnasium.spaces.MultiDiscrete):
                action = random.integers(space.nvec)
            else:
                action = random.uniform(space.low, space.high).astype(np.float32)
            _, _, terminated, truncated, _ = env.step(action)
            is_running = not (terminated or truncated)
            found.append(checksum(env.get_state()))
    # The text of a space leaves out long vectors.
    return {
        "space": checksum(repr(flat(env.state_space))),
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
    import popgym

    made = {each["id"]: kind for kind, each in popgym.envs.ALL.items()}
    print(json.dumps({id: states(kind(), int(sys.argv[1])) for id, kind in made.items()}, separators=(",", ":")))
