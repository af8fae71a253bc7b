"""The environments that an agent trains on: groups of them, stepped while the agent is busy with another group."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endless_gym.agents.settings import TRAINING_SEEDS, Settings
from endless_gym.engine import serve
from endless_gym.specs import Spec, spec
from endless_gym.vector import EndlessVectorEnv, make_vec


@dataclass
class Received:
    """What one step of a group of n environments brought.

    Attributes:
        observation: Of the step's end; where an episode has ended, the next one's first.
        reward: float64 (n,)
        done: bool (n,)
        ground_truth: What `info` says of the observation, float64 (n, entries), or None.
        episodes: The final infos of the episodes that ended, one dict each.
    """

    observation: Any
    reward: NDArray[np.float64]
    done: NDArray[np.bool_]
    ground_truth: NDArray[np.float64] | None
    episodes: list[dict[str, float]]


class Environments:
    """Groups of environments that step at their own pace: `send` a group's actions, do something else, `receive`.

    Each episode draws its seed from 0 to 99,999, as in the paper's training.
    """

    def __init__(self, settings: Settings) -> None:
        wanted = settings.environment
        self.spec: Spec = spec(settings.env)
        self.groups, self.per_group = wanted.groups, wanted.num_envs // wanted.groups
        in_process = wanted.engine == "thread"
        arguments: dict[str, Any] = {
            "num_envs": self.per_group,
            "num_threads": wanted.num_threads or None,
            "groups": wanted.groups,
            "seed": settings.seed,
            "seeds": TRAINING_SEEDS,
            "options": settings.options(),
            "autoreset": "same_step",
            "observation": wanted.observation,
        }
        try:
            self._envs: EndlessVectorEnv = (make_vec if in_process else serve)(settings.env, **arguments)
        except RuntimeError as error:  # An engine that cannot start says why.
            raise ValueError(str(error)) from error
        # In this process a group steps in a thread, which needs no interpreter while it does.
        self._thread = ThreadPoolExecutor(1, "environments") if in_process else None
        self._results: dict[int, Future[Any]] = {}

    def reset(self, group: int) -> Received:
        """Start episodes in all environments of a group."""
        observation, info = self._envs.reset(group=group)
        return self._start(observation, info)

    def send(self, actions: NDArray[np.int64], group: int) -> None:
        """Step a group, without waiting for it; actions (n, branches)."""
        self._envs.send(actions, group)
        if self._thread is not None:
            self._results[group] = self._thread.submit(self._envs.recv, group)

    def receive(self, group: int) -> Received:
        """What came of a group's actions."""
        result = self._results.pop(group).result() if self._thread is not None else self._envs.recv(group)
        observation, reward, terminated, truncated, info = result
        done = terminated | truncated
        episodes = []
        if "final_info" in info:
            final = {key: value for key, value in info["final_info"].items() if not key.startswith("_")}
            final.pop("ground_truth", None)
            episodes = [{key: float(value[env]) for key, value in final.items()} for env in np.flatnonzero(done)]
        return Received(observation, reward, done, info.get("ground_truth"), episodes)

    def snapshots(self) -> list[list[bytes]]:
        """The states of all environments of each group."""
        return [[self._envs.snapshot(env, group) for env in range(self.per_group)] for group in range(self.groups)]

    def restore(self, snapshots: list[list[bytes]]) -> list[Received]:
        """Go on from `snapshots`."""
        return [self._start(*self._envs.restore(dict(enumerate(each)), group)) for group, each in enumerate(snapshots)]

    def close(self) -> None:
        """End the engine and give up its memory."""
        if self._thread is not None:
            self._thread.shutdown(wait=True)
        self._envs.close()

    def __enter__(self) -> Environments:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _start(self, observation: Any, info: dict[str, Any]) -> Received:
        nothing = np.zeros(self.per_group)
        return Received(observation, nothing, nothing.astype(np.bool_), info.get("ground_truth"), [])
