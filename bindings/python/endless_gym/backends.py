"""Where the environments of a vector environment run: in this process (`_native.Pools`), or in an engine process
(`_native.Connection`). Both raise the same exceptions with the same messages for the same mistakes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from endless_gym import _native


class Backend(Protocol):
    """The environments of all groups. The caller checks group numbers."""

    @property
    def groups(self) -> int:
        """Number of groups."""

    def reset(self, group: int, request: _native.Reset | None = None, options: str | None = None) -> _native.Arrays:
        """Reset a group, and return its arrays."""

    def step(self, actions: Any) -> _native.Arrays:
        """Step group 0, and return its arrays."""

    def send(self, actions: Any, group: int) -> None:
        """Step a group; `receive` returns its arrays. The actions are copied."""

    def send_reset(self, group: int, request: _native.Reset | None = None, options: str | None = None) -> None:
        """Reset a group; `receive` returns its arrays."""

    def receive(self, group: int | None) -> tuple[int, _native.Arrays]:
        """The number and the arrays of a group whose result is ready; `None` waits for any group."""

    def snapshot(self, group: int, env: int) -> bytes:
        """The state of one environment."""

    def restore(self, group: int, env: int, snapshot: bytes) -> None:
        """Set the state of one environment."""

    def set_options(self, group: int, sets: str) -> None:
        """Set the options of next episodes, from the JSON text of a list of objects with `options` and `envs`."""

    def running_episodes(self, group: int, envs: Sequence[int]) -> list[_native.Episode]:
        """Seeds and options of the running episodes of environments."""

    def close(self) -> None:
        """Release the environments. Arrays remain valid."""


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
