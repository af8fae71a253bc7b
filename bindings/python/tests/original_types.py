"""The types of what single environments return. As a program, it prints those of the original, `memory_gym` or `popgym`, as JSON.

`original_types.json` has what it printed for memory-gym 1.0.2 and popgym 1.0.7.
"""

from __future__ import annotations

import json
from typing import Any

import gymnasium
import numpy as np


def described(value: Any) -> str:
    """A type, with the dtypes and shapes of arrays."""
    if isinstance(value, tuple):
        return f"({', '.join(map(described, value))})"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {described(part)}' for key, part in sorted(value.items()))}}}"
    return f"{value.dtype}{list(value.shape)}" if isinstance(value, np.ndarray) else type(value).__name__


def types(env: Any) -> dict[str, list[str]]:
    """The types of observations, rewards and final infos in 1,100 random steps."""
    found: dict[str, set[str]] = {"observation": set(), "reward": set(), "info": set()}
    env.action_space.seed(0)
    observation, _ = env.reset(seed=1)
    for _ in range(1100):
        found["observation"].add(described(observation))
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        is_end = terminated or truncated
        found["reward"].add(f"{described(reward)}{'' if reward else '0'}{' at the end' if is_end else ''}")
        if is_end:
            found["info"] |= {f"{name}: {described(value)}" for name, value in info.items()}
            observation, _ = env.reset()
    return {name: sorted(each) for name, each in found.items()}


if __name__ == "__main__":
    try:
        import popgym

        ids = [each["id"] for each in popgym.envs.ALL_EASY.values()]
    except ImportError:
        import memory_gym  # noqa: F401

        ids = [id for id in gymnasium.registry if "Mortar" in id or "Mystery" in id or "Searing" in id]
    print(json.dumps({id: types(gymnasium.make(id, disable_env_checker=True).unwrapped) for id in ids}))
