"""Resets of a vector environment: which environments start an episode, and with which seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.arguments import first_seed, flags, integer

Seeds = int | Sequence[int | None] | NDArray[np.integer[Any]] | None


class ResetRequests:
    """The resets of a vector environment in the native module's format."""

    def __init__(self, num_envs: int, num_groups: int, first_env: int) -> None:
        self._num_envs, self._num_groups, self._first_env = num_envs, num_groups, first_env

    def envs(self, mask: Any, name: str = "reset_mask") -> Sequence[int]:
        """The numbers of the environments in a mask; all for `None`."""
        return range(self._num_envs) if mask is None else np.flatnonzero(flags(name, mask, self._num_envs)).tolist()

    def request(self, seed: Seeds, mask: Any, group: int) -> _native.Reset | None:
        """A reset of a group."""
        if mask is None and not _has_items(seed):
            return None if seed is None else self._first_seed(seed)
        chosen = [True] * self._num_envs if mask is None else flags("reset_mask", mask, self._num_envs)
        seeds = self._seeds(seed, group)
        reset = [int(wanted) * (1 if given is None else 2) for wanted, given in zip(chosen, seeds, strict=True)]
        return reset, [given or 0 for given in seeds]

    def _first_seed(self, seed: Any) -> int:
        return first_seed(seed, self._first_env + self._num_groups * self._num_envs)

    def _seeds(self, seed: Seeds, group: int) -> list[int | None]:
        """One seed for each environment of a group."""
        if seed is None:
            return [None] * self._num_envs
        if not _has_items(seed):
            first = self._first_seed(seed) + self._first_env + group * self._num_envs
            return list(range(first, first + self._num_envs))
        given: list[Any] = list(seed)
        if len(given) == self._num_envs * self._num_groups:
            given = given[group * self._num_envs :][: self._num_envs] if self._num_groups > 1 else given
        elif len(given) != self._num_envs:
            allowed = f"{self._num_envs} items, one for each environment"
            if self._num_groups > 1:
                allowed += f" of a group, or {self._num_envs * self._num_groups} for all groups"
            raise ValueError(f"seed must have {allowed}, got {len(given)}")
        return [None if each is None else integer("seed", each) for each in given]


def _has_items(seed: Seeds) -> TypeGuard[Sequence[int | None]]:
    """Whether there is a seed for each environment, instead of one for all."""
    return (isinstance(seed, Sequence) and not isinstance(seed, (str, bytes))) or (
        isinstance(seed, np.ndarray) and seed.ndim > 0
    )
