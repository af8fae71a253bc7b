"""The scripted experts, for any vector environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.arguments import flags, integer
from endless_gym.specs import Spec, spec


class Experts:
    """One scripted expert for each of n environments. It reads the features and remembers what an agent must remember.

    Examples:
        >>> import endless_gym
        >>> import numpy as np
        >>> envs = endless_gym.make_vec("MysteryPath-Grid-v0", 8, observation="features", autoreset="same_step", seed=0)
        >>> experts = endless_gym.Experts("MysteryPath-Grid-v0", 8)
        >>> observation, info = envs.reset()
        >>> is_first = np.ones(8, dtype=bool)
        >>> rewards = np.zeros(8)
        >>> for _ in range(100):
        ...     observation, reward, terminated, truncated, info = envs.step(experts.act(observation, is_first))
        ...     is_first = terminated | truncated
        ...     rewards += reward
        >>> bool((rewards >= 1).all())  # each of them has found a goal
        True

    Args:
        id: Environment id, such as `Endless-MortarMayhem-v0`.
        num_envs: Number of environments.

    Raises:
        TypeError: `num_envs` is not an integer.
        ValueError: There is no such id, or `num_envs` is out of its range.
    """

    def __init__(self, id: str, num_envs: int = 1) -> None:
        self._spec: Spec = spec(id)
        self.num_envs = integer("num_envs", num_envs, 1, _native.MAX_ENVS)
        self._native = self._spec.native.Experts(self._spec.id, self.num_envs)

    def act(self, observation: Any, episode_start: Any, active: Any = None) -> NDArray[Any]:
        """Choose the actions. Call it exactly once for each observation, including the first of an episode.

        Args:
            observation: What a vector environment with `observation="features"` or `"rgb+features"` returns: the features,
                float32 (n, f), integers or a tuple; or a dict with `features` and, for the ids that have one,
                `vector_observation`, float32 (n, v).
            episode_start: Whether the observation is the first of an episode, bool (n,).
            active: The environments that need an action, bool (n,); the others' actions are 0. `None` for all.

        Returns:
            Actions as a vector environment takes them: int64 (n,) for Discrete, int64 (n, branches) for MultiDiscrete,
            float32 (n, dimensions) for a Box.

        Raises:
            ValueError: An array has another shape, or `features` or `vector_observation` is missing.
        """
        parts = observation if isinstance(observation, Mapping) else {"features": observation}
        needed = ["features", *(["vector_observation"] if self._spec.vector_observation else [])]
        if any(name not in parts for name in needed):
            raise ValueError(f"observation must have {' and '.join(needed)}, got {', '.join(parts)}")
        arrays = [np.ascontiguousarray(self._numbers(parts[name]), dtype=np.float32) for name in needed]
        turn = np.where(flags("episode_start", episode_start, self.num_envs), np.uint8(2), np.uint8(1))
        if active is not None:
            turn[~flags("active", active, self.num_envs)] = 0
        for name, array in zip(needed, arrays, strict=True):
            columns = len(self._spec.features) if name == "features" else self._spec.vector_observation
            if array.shape != (self.num_envs, columns):
                raise ValueError(f"{name} must have the shape ({self.num_envs}, {columns}), got {array.shape}")
        vector = arrays[1] if len(arrays) > 1 else None
        return self._spec.batched_actions(self._native.act(arrays[0], vector, turn))

    def _numbers(self, observation: Any) -> Any:
        """The numbers of observations as rows, the inverse of `Spec.feature_observation`."""
        if isinstance(observation, tuple):
            return np.concatenate([self._numbers(part) for part in observation], axis=-1)
        is_discrete = self._spec.described_features is not None and np.ndim(observation) == 1
        return np.asarray(observation)[:, None] if is_discrete else observation
