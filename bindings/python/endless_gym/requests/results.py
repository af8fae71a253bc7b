"""What `reset` and `step` return, from the arrays of a batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.requests.configuration import AutoresetMode
from endless_gym.specs import Frames, Spec

Step = tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]

#: The keys of an observation, by the sections of a batch.
_OBSERVATIONS = {
    "observation": "visual_observation",
    "features": "features",
    "vector_observation": "vector_observation",
}


class Results:
    """Names the arrays of a batch as Gymnasium does.

    Attributes:
        described: The specification of the environment id.
        autoreset: The auto-reset mode.
        num_envs: Environments of a batch.
        observation_space: The space of one environment's observation.
        copy: Whether all arrays are writable copies.
        state_space: The space of one environment's Markov state; `None` if `info` does not have it.
        has_final_observation: Whether `info` has the last observation of an episode that ended.
    """

    def __init__(
        self,
        described: Spec,
        layout: Mapping[str, Any],
        num_envs: int,
        frames: Frames | None,
        autoreset: AutoresetMode,
        copy: bool,
    ) -> None:
        """`layout` is the layout of a batch; with `copy`, all arrays are writable copies."""
        self.described, self.autoreset, self.num_envs, self.copy = described, autoreset, num_envs, copy
        self._index = {section["name"]: place for place, section in enumerate(layout["sections"])}
        self._observed = self._places("")
        self._final_observed = self._places("final_")
        self.has_final_observation = bool(self._final_observed)
        self.observation_space = described.observation_space(frames, "features" in self._index)
        self._infos = [(name, self._index[name]) for name in ("ground_truth", "state") if name in self._index]
        self.state_space = described.state_space() if "state" in self._index else None
        self._steps = [self._index[name] for name in ("reward", "terminated", "truncated")]
        self._ends = [self._index[name] for name in ("episode_return", "episode_length", "info")]
        self._integers = [is_integer for _, is_integer in described.info]
        self._same_step = autoreset is AutoresetMode.SAME_STEP
        self._all = np.ones(num_envs, dtype=np.bool_)
        self._all.flags.writeable = False

    def start(self, arrays: _native.Arrays) -> tuple[Any, dict[str, Any]]:
        """What a reset returns."""
        arrays = self._copied(arrays)
        return self._observation(arrays), self._info(arrays)

    def step(self, arrays: _native.Arrays) -> Step:
        """What a step returns."""
        arrays = self._copied(arrays)
        reward, terminated, truncated = (arrays[place] for place in self._steps)
        info = self._info(arrays)
        self._add_ends(info, arrays, terminated | truncated)
        return self._observation(arrays), reward, terminated, truncated, info

    def _places(self, prefix: str) -> list[tuple[str, int]]:
        sections = ((key, self._index.get(prefix + name)) for name, key in _OBSERVATIONS.items())
        return [(key, place) for key, place in sections if place is not None]

    def _copied(self, arrays: _native.Arrays) -> _native.Arrays:
        return tuple(array.copy() for array in arrays) if self.copy else arrays

    def _observation(self, arrays: _native.Arrays) -> Any:
        parts = {key: arrays[place] for key, place in self._observed}
        return self._named(parts, self.described.feature_observation)

    def _named(self, parts: dict[str, Any], observed: Callable[[Any], Any]) -> Any:
        """The parts as a dict, or the only one; `observed` makes an observation of features."""
        if "features" in parts:
            parts["features"] = observed(parts["features"])
        return parts if len(parts) > 1 else next(iter(parts.values()))

    def _info(self, arrays: _native.Arrays) -> dict[str, Any]:
        info: dict[str, Any] = {}
        for name, place in self._infos:
            info[name], info[f"_{name}"] = arrays[place], self._all.copy() if self.copy else self._all
        return info

    def _add_ends(self, info: dict[str, Any], arrays: _native.Arrays, ended: NDArray[np.bool_]) -> None:
        """Adds the infos of the episodes that this step ended, if it ended any."""
        returns, lengths, infos = (arrays[place] for place in self._ends)
        ends = _native.ended_episodes(ended, returns, lengths, infos, self._integers)
        if ends is None:
            return
        ended, returns, lengths, columns = ends
        final: dict[str, Any] = {"reward": returns, "_reward": ended, "length": lengths, "_length": ended}
        for (name, _), column in zip(self.described.info, columns, strict=True):
            final[name], final[f"_{name}"] = column, ended
        if not self._same_step:
            info.update(final)
            return
        for name, _ in self._infos:
            if (place := self._index.get(f"final_{name}")) is not None:
                final[name], final[f"_{name}"] = np.where(ended[:, None], arrays[place], 0), ended
        info["final_info"], info["_final_info"] = final, ended
        if not self.has_final_observation:
            return
        observations = np.full(self.num_envs, None, dtype=object)
        for env in np.flatnonzero(ended):
            parts = {key: arrays[place][env] for key, place in self._final_observed}
            observations[env] = self._named(parts, self.described.single_observation)
        info["final_obs"], info["_final_obs"] = observations, ended
