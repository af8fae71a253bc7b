"""An engine process that is replaced when it fails, so that training continues as if nothing had happened."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from endless_gym import EngineLost
from endless_gym.requests.results import Step
from endless_gym.vector import EndlessVectorEnv

T = TypeVar("T")

#: Number of engine restarts without a completed update in between.
MAX_RESTARTS = 3


class RecoverableEngine:
    """Vector environments in an engine process, with the record needed to bring other environments to the same state.

    Environments are deterministic: restoring the snapshots of a consistent point and replaying the actions sent since gives the
    same state in a new engine. `mark` moves the point forward. The methods are those of `EndlessVectorEnv`; they return the same
    results whether the engine fails or not.

    Attributes:
        report: Called with a line of text for each failure and each recovery.
        failure: Why the engine was given up, so that the environments now run in this process; None if it was not.
    """

    def __init__(
        self,
        policy: Literal["restart", "save", "fail"],
        serve: Callable[[], EndlessVectorEnv],
        make: Callable[[], EndlessVectorEnv],
    ) -> None:
        """Start the engine.

        Args:
            policy: What to do when the engine fails. `restart`: start another one; give up after `MAX_RESTARTS` restarts without
                a `mark`. `save`: give up at once. `fail`: raise the error.
            serve: Starts an engine. The seeds of its environments must be given, so that each engine plays the same episodes.
            make: Makes the same environments in this process.
        """
        self.report: Callable[[str], None] = print
        self.failure: str | None = None
        self._policy, self._serve, self._make = policy, serve, make
        self._envs = serve()
        groups = range(self._envs.num_groups)
        # For each group: the snapshots of the point (None for the first reset), the actions since, and whether the result of the
        # last actions is pending.
        self._points: list[Mapping[int, bytes] | None] = [None for _ in groups]
        self._actions: list[list[NDArray[np.int64]]] = [[] for _ in groups]
        self._pending = [False for _ in groups]
        self._restarts = 0

    @property
    def unwrapped(self) -> EndlessVectorEnv:
        """The environments of the current engine, or those that replaced it in this process."""
        return self._envs

    def reset(self, *, group: int) -> tuple[Any, dict[str, Any]]:
        """Start the first episode in every environment of a group."""
        return self._call(lambda envs: envs.reset(group=group))

    def send(self, actions: NDArray[np.int64], group: int) -> None:
        """Start a step of a group."""
        self._call(lambda envs: envs.send(actions, group))
        self._actions[group].append(actions.copy())
        self._pending[group] = True

    def recv(self, group: int) -> Step:
        """Wait for the result of a group's last `send`."""
        result = self._call(lambda envs: envs.recv(group))
        self._pending[group] = False
        return result

    def snapshot(self, env: int, group: int) -> bytes:
        """The state of one environment."""
        return self._call(lambda envs: envs.snapshot(env, group))

    def restore(self, snapshots: Mapping[int, bytes], group: int) -> tuple[Any, dict[str, Any]]:
        """Set the states of all environments of a group."""
        result = self._call(lambda envs: envs.restore(snapshots, group))
        self._points[group], self._actions[group] = snapshots, []
        return result

    def mark(self) -> None:
        """Make the current state, with no result pending, the point from which another engine can continue."""
        points = [
            {env: self.snapshot(env, group) for env in range(self._envs.num_envs)} for group in range(len(self._points))
        ]
        self._points, self._actions, self._restarts = list(points), [[] for _ in points], 0

    def close(self) -> None:
        """Close the environments and end the engine process."""
        self._envs.close()

    def _call(self, call: Callable[[EndlessVectorEnv], T]) -> T:
        while True:
            try:
                return call(self._envs)
            except (EngineLost, TimeoutError) as error:
                if self._policy == "fail" or self.failure is not None:
                    raise
                self._recover("does not answer" if isinstance(error, TimeoutError) else "has ended")

    def _recover(self, reason: str) -> None:
        """Replace the engine."""
        while True:
            self._envs.close()
            self._restarts += 1
            steps = sum(map(len, self._actions))
            try:
                if self._policy == "save" or self._restarts > MAX_RESTARTS:
                    self.failure = f"the engine process {reason}"
                    if self._policy == "restart":
                        self.failure += f" after {MAX_RESTARTS} restarts without a completed update"
                    self.report(f"{self.failure}; the update is completed in this process")
                    self._replay(self._make())
                else:
                    self.report(f"the engine process {reason}; restart {self._restarts} of {MAX_RESTARTS}")
                    self._replay(self._serve())
                    self.report(
                        f"a new engine process continues the update, after {steps} steps that were played again"
                    )
                return
            except (EngineLost, TimeoutError, RuntimeError, OSError) as error:
                if self.failure is not None:
                    raise
                reason = f"cannot be replaced ({error})"

    def _replay(self, envs: EndlessVectorEnv) -> None:
        """Bring new environments to the state of the failed ones, and use them from now on."""
        self._envs = envs
        for group, (point, log) in enumerate(zip(self._points, self._actions, strict=True)):
            envs.reset(group=group)
            if point is not None:
                envs.restore(point, group)
            for number, actions in enumerate(log, 1):
                envs.send(actions, group)
                if number < len(log) or not self._pending[group]:
                    envs.recv(group)
