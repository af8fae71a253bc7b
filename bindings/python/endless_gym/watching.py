"""Observes the batches of an engine that another process trains with."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.arguments import integer
from endless_gym.arguments import timeout as checked_timeout
from endless_gym.create import specified_results
from endless_gym.requests.exceptions import EngineLost


class WatchedBatch(NamedTuple):
    """What one step or reset of a group of n environments returned to the trainer."""

    #: As `EndlessVectorEnv.step` returns it: uint8 (n, 84, 84, 3) by default, or a dict of arrays.
    observation: Any
    #: float64 (n,); 0 after a reset.
    reward: NDArray[np.float64]
    #: bool (n,).
    terminated: NDArray[np.bool_]
    #: bool (n,).
    truncated: NDArray[np.bool_]
    #: As `EndlessVectorEnv.step` returns it.
    info: dict[str, Any]
    #: Number of the batch: how many the group has returned since the engine started, including this one.
    step: int
    #: Number of the group.
    group: int
    #: Batches of the group that were missed between the previous watched batch and this one.
    missed: int


class Watch:
    """The batches of a running engine, as an iterator that ends with the engine. `watch` makes it.

    Iterating waits for the next batch. It never makes the trainer wait: a watch that is slower than the trainer misses batches.

    Attributes:
        id: Environment id.
        num_envs: Environments in each group.
        num_groups: Groups of the engine.
        observation_space: Space of a batch's observation.
        action_space: Space of a batch's actions.
        missed: Batches that were missed so far.
    """

    def __init__(self, service: str, group: int | None, timeout: float | None, copy: bool) -> None:
        """Called by `watch`."""
        self._timeout = None if timeout is None else checked_timeout(timeout)
        group = None if group is None else integer("group", group)
        # A year, which stands for no limit.
        observer = _native.Observer(service, group, 3e7 if self._timeout is None else self._timeout)
        specification = json.loads(observer.specification())
        self._observer: _native.Observer | None = observer
        self._results = specified_results(specification, copy)
        self.id: str = specification["id"]
        self.num_envs, self.num_groups = specification["num_envs"], specification["groups"]
        self.observation_space = batch_space(self._results.observation_space, self.num_envs)
        self.action_space = batch_space(self._results.described.action_space(), self.num_envs)
        self.missed = 0

    def __iter__(self) -> Watch:
        return self

    def __next__(self) -> WatchedBatch:
        """Wait for the next batch.

        Raises:
            StopIteration: The engine has ended, or `close` was called.
            TimeoutError: No batch arrived in time. The next call waits again.
            TooManyBatchesHeld: Arrays of as many batches as the engine lends are referenced; delete them, or use `copy=True`.
        """
        if self._observer is None:
            raise StopIteration
        try:
            group, step, missed, arrays = self._observer.next(self._timeout)
        except EngineLost:
            self.close()
            raise StopIteration from None
        self.missed += missed
        observation, reward, terminated, truncated, info = self._results.step(arrays)
        return WatchedBatch(observation, reward, terminated, truncated, info, step, group, missed)

    def close(self) -> None:
        """Disconnect. Arrays remain valid."""
        self._observer = None

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def watch(service: str, *, group: int | None = None, timeout: float | None = 30.0, copy: bool = False) -> Watch:
    """Watch the batches of a running engine alongside its trainer, which never waits for the watch.

    ```python
    import endless_gym

    with endless_gym.watch("mortar") as batches:
        for batch in batches:
            print(batch.step, batch.reward.mean(), batch.missed)
    ```

    The arrays are read-only views of the memory that the engine wrote, which it does not overwrite while an array of the batch
    exists. It lends as many batches of a group to an observer as to its trainer (`batches_held`). A loop holds up to two.

    Args:
        service: The engine's name.
        group: Number of the group to watch; `None` for all.
        timeout: Seconds to wait for the engine to start, and then for each batch; `None` to wait without a limit. A
            `TimeoutError` does not end the watch: iterating again waits again.
        copy: Yield writable copies instead of read-only views of shared memory.

    Raises:
        ConnectionError: There is no such engine, or it has as many observers as it accepts.
        RuntimeError: There is not enough shared memory for the batches that the observer may hold.
        ValueError: There is no such group, or the timeout is negative or not finite.
    """
    return Watch(service, group, timeout, copy)
