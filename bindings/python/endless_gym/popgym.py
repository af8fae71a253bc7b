"""POPGym's wrappers for vector environments: its agents observe the previous action and which step is the first."""

from __future__ import annotations

from itertools import compress
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatten_space
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray


class PreviousAction(VectorWrapper):
    """Adds the previous action to observations, as POPGym's `PreviousAction`: (observation, action), for Discrete, MultiDiscrete
    and Box spaces, and Tuples of them. In the first step of an episode, the action is 0.

    Args:
        envs: A vector environment, whose groups, if it has several, are not stepped apart.
        previous_action: Add the previous action.
        antialias: Add a last part, 1 in the first step of an episode and otherwise 0, as POPGym's `Antialias`.
        flatten: Return arrays (n, k), in which integers are one-hot, as POPGym's `Flatten`.
    """

    def __init__(
        self,
        envs: VectorEnv[Any, Any, Any],
        *,
        previous_action: bool = True,
        antialias: bool = True,
        flatten: bool = False,
    ) -> None:
        super().__init__(envs)
        observed = envs.single_observation_space
        parts = observed.spaces if isinstance(observed, spaces.Tuple) else (observed,)
        space = spaces.Tuple((*parts, *[envs.single_action_space] * previous_action, *[spaces.Discrete(2)] * antialias))
        self._is_added, self._parts = (previous_action, antialias), space.spaces
        self._flat = flatten_space(space) if flatten else None
        self.single_observation_space = space if self._flat is None else self._flat
        self.observation_space = batch_space(self.single_observation_space, envs.num_envs)
        self._mode = envs.metadata["autoreset_mode"]
        self._none = np.zeros_like(envs.action_space.sample())
        if isinstance(envs.action_space, spaces.Box):
            self._none = self._none.clip(envs.action_space.low, envs.action_space.high)
        self._actions = self._none.copy()
        self._ended = np.zeros(envs.num_envs, np.bool_)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or in those of `options["reset_mask"]`."""
        observation, info = self.env.reset(seed=seed, options=options)
        first = (options or {}).get("reset_mask", np.ones_like(self._ended))
        self._ended = self._ended & ~first
        return self._extended(observation, first), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Play one step."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        # A copy, since the caller may reuse the array.
        self._actions = np.array(actions, self._none.dtype).reshape(self._none.shape)
        ended = terminated | truncated
        if "final_obs" in info:
            final = np.full(self.num_envs, None, dtype=object)
            for env in np.flatnonzero(info["_final_obs"]):
                final[env] = self._single(info["final_obs"][env], int(env))
            info = {**info, "final_obs": final}
        first = {AutoresetMode.NEXT_STEP: self._ended, AutoresetMode.SAME_STEP: ended}.get(self._mode)
        self._ended = ended
        return (
            self._extended(observation, np.zeros_like(ended) if first is None else first),
            reward,
            terminated,
            truncated,
            info,
        )

    def _extended(self, observation: Any, first: NDArray[np.bool_]) -> Any:
        """Observations with their actions; `first` says which are the first of an episode."""
        self._actions[first] = self._none[first]
        return self._joined(observation, self._actions.copy(), first.astype(np.int64))

    def _single(self, observation: Any, env: int) -> Any:
        """The last observation of an episode."""
        parts = observation if isinstance(observation, tuple) else (observation,)
        batch = self._joined(
            tuple(np.asarray(part)[None] for part in parts), self._actions[[env]], np.zeros(1, np.int64)
        )
        return batch[0] if self._flat is not None else tuple(part[0] for part in batch)

    def _joined(self, observation: Any, actions: NDArray[Any], first: NDArray[np.int64]) -> Any:
        parts = observation if isinstance(observation, tuple) else (observation,)
        parts = (*parts, *compress((actions, first), self._is_added))
        if self._flat is None:
            return parts
        columns = [_flattened(space, part) for space, part in zip(self._parts, parts, strict=True)]
        return np.concatenate(columns, axis=1, dtype=self._flat.dtype)


def _flattened(space: spaces.Space[Any], batch: NDArray[Any]) -> NDArray[Any]:
    """The rows of a batch as vectors, (n, k)."""
    if isinstance(space, spaces.Discrete):
        return _one_hot(int(space.n), batch)
    if isinstance(space, spaces.MultiDiscrete):
        columns = zip(space.nvec, batch.T, strict=True)
        return np.concatenate([_one_hot(int(choices), column) for choices, column in columns], axis=1)
    return batch.reshape(len(batch), -1)


def _one_hot(choices: int, integers: NDArray[Any]) -> NDArray[np.int64]:
    one_hot: NDArray[np.int64] = (integers[:, None] == np.arange(choices)).astype(np.int64)
    return one_hot
