"""Where the environments of a vector environment run: in this process, or in an engine process.

Both have the same interface, and raise the same exceptions with the same messages for the same mistakes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from endless_gym import _native


class GroupReconnection(NamedTuple):
    """What `reconnect` found out about a group."""

    #: Batches that the group has returned in the engine that is connected now, counted on from the checkpoint that it resumed
    #: from; `None` if its status cannot be read.
    step: int | None
    #: Batches that it had returned in the engine that ended; `None` if the engine is the same, or if its status cannot be read.
    lost_step: int | None
    #: What became of the last request: `none` if there was none, `pending` if `recv` can return its result, `played` if it was
    #: executed once, `not_played` if never, and `unknown` if the engine ended while it executed it.
    last_request: _native.LastRequest


class Reconnection(NamedTuple):
    """What `reconnect` found."""

    #: Whether the engine is another run than before. Otherwise the connection and the results that were not received are kept.
    restarted: bool
    #: A number that identifies the run of the engine that is connected now.
    incarnation: int
    #: By group.
    groups: list[GroupReconnection]


class Backend:
    """The environments of all groups. Group numbers are checked by the caller."""

    #: Number of groups.
    groups = 1

    def reset(self, group: int, request: _native.Reset | None, options: str | None) -> _native.Arrays:
        """Reset a group, and return its arrays."""
        raise NotImplementedError

    def step(self, actions: Any) -> _native.Arrays:
        """Step group 0, and return its arrays."""
        raise NotImplementedError

    def send(self, actions: Any, group: int) -> None:
        """Step a group; `receive` returns its arrays. The actions are copied."""
        raise NotImplementedError

    def send_reset(self, group: int, request: _native.Reset | None, options: str | None) -> None:
        """Reset a group; `receive` returns its arrays."""
        raise NotImplementedError

    def receive(self, group: int | None) -> tuple[int, _native.Arrays]:
        """The number and the arrays of a group whose result is ready; `None` waits for any group."""
        raise NotImplementedError

    def snapshot(self, group: int, env: int) -> bytes:
        """The state of one environment."""
        raise NotImplementedError

    def restore(self, group: int, env: int, snapshot: bytes) -> None:
        """Set the state of one environment."""
        raise NotImplementedError

    def set_options(self, group: int, sets: str) -> None:
        """Set the options of next episodes, from the JSON text of a list of objects with `options` and `envs`."""
        raise NotImplementedError

    def running_episodes(self, group: int, envs: Sequence[int]) -> list[_native.Episode]:
        """What the running episodes of environments follow from."""
        raise NotImplementedError

    def ground_truth_view(self, env: int) -> NDArray[np.uint8]:
        """The ground-truth view of one environment of group 0."""
        raise RuntimeError("the environments are in another process; make them with `make_vec` for this")

    def checkpoint(self) -> list[int]:
        """Save all environments to the engine's checkpoint file."""
        raise RuntimeError("the environments are in this process; use `snapshot` to save them")

    def reconnect(self, timeout: float) -> Reconnection:
        """Connect to an engine that replaces a lost one."""
        raise RuntimeError("the environments are in this process; there is no engine to reconnect to")

    def close(self) -> None:
        """Release the environments."""
        raise NotImplementedError


class InProcess(Backend):
    """Environments in this process, in one pool for each group."""

    def __init__(self, pools: list[_native.Pool]) -> None:
        self._pools = pools
        self.groups = len(pools)
        # The groups that have not been received, in the order in which they were sent.
        self._sent: dict[int, None] = {}

    def reset(self, group: int, request: _native.Reset | None, options: str | None) -> _native.Arrays:
        return self._pool(group).reset(request, options)

    def step(self, actions: Any) -> _native.Arrays:
        return self._pool(0).step(actions)

    def send(self, actions: Any, group: int) -> None:
        self._pool(group).send(actions)
        self._sent[group] = None

    def send_reset(self, group: int, request: _native.Reset | None, options: str | None) -> None:
        self._pool(group).send_reset(request, options)
        self._sent[group] = None

    def receive(self, group: int | None) -> tuple[int, _native.Arrays]:
        group = next(iter(self._sent), 0) if group is None else group
        pool = self._pool(group)
        self._sent.pop(group, None)
        return group, pool.receive()

    def snapshot(self, group: int, env: int) -> bytes:
        return self._pool(group).snapshot(env)

    def restore(self, group: int, env: int, snapshot: bytes) -> None:
        self._pool(group).restore(env, snapshot)

    def set_options(self, group: int, sets: str) -> None:
        self._pool(group).set_options(sets)

    def running_episodes(self, group: int, envs: Sequence[int]) -> list[_native.Episode]:
        return self._pool(group).running_episodes(envs)

    def ground_truth_view(self, env: int) -> NDArray[np.uint8]:
        return self._pool(0).ground_truth_view(env)

    def close(self) -> None:
        self._pools, self._sent = [], {}

    def _pool(self, group: int) -> _native.Pool:
        if not self._pools:
            raise RuntimeError("the environments are closed")
        return self._pools[group]


class Remote(Backend):
    """Environments in an engine process. `engine` is that process if it belongs to this object."""

    def __init__(self, connection: _native.Connection, groups: int, timeout: float, engine: Any = None) -> None:
        self._connection: _native.Connection | None = connection
        self.groups = groups
        self._timeout = timeout
        self._engine = engine

    def reset(self, group: int, request: _native.Reset | None, options: str | None) -> _native.Arrays:
        self._connected().reset(group, request, options)
        return self._connected().receive(group, self._timeout)[1]

    def step(self, actions: Any) -> _native.Arrays:
        connection = self._connected()
        connection.send(0, actions)
        return connection.receive(0, self._timeout)[1]

    def send(self, actions: Any, group: int) -> None:
        self._connected().send(group, actions)

    def send_reset(self, group: int, request: _native.Reset | None, options: str | None) -> None:
        self._connected().reset(group, request, options)

    def receive(self, group: int | None) -> tuple[int, _native.Arrays]:
        return self._connected().receive(group, self._timeout)

    def snapshot(self, group: int, env: int) -> bytes:
        return self._connected().snapshot(group, env, self._timeout)

    def restore(self, group: int, env: int, snapshot: bytes) -> None:
        self._connected().restore(group, env, snapshot, self._timeout)

    def set_options(self, group: int, sets: str) -> None:
        self._connected().set_options(group, sets, self._timeout)

    def running_episodes(self, group: int, envs: Sequence[int]) -> list[_native.Episode]:
        return self._connected().running_episodes(group, envs, self._timeout)

    def checkpoint(self) -> list[int]:
        return self._connected().checkpoint(self._timeout)

    def reconnect(self, timeout: float) -> Reconnection:
        restarted, incarnation, groups = self._connected().reconnect(timeout)
        return Reconnection(restarted, incarnation, [GroupReconnection(*group) for group in groups])

    def close(self) -> None:
        self._connection = None
        if self._engine is not None:
            self._engine.end()

    def _connected(self) -> _native.Connection:
        if self._connection is None:
            raise RuntimeError("the environments are closed")
        return self._connection
