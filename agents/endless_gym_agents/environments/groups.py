"""The training environments, in groups: an engine process steps one group while the agent computes the actions for another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endless_gym.create import make_vec
from endless_gym.engine import serve
from endless_gym.episodes import EpisodeOptions
from endless_gym.specs import Spec, spec
from endless_gym.vector import EndlessVectorEnv
from endless_gym_agents.environments.ranks import Ranks
from endless_gym_agents.environments.recovery import RecoverableEngine
from endless_gym_agents.environments.view import ViewProcess
from endless_gym_agents.environments.wrappers import WrappedGroups
from endless_gym_agents.settings import TRAINING_SEEDS, Settings


@dataclass
class StepResult:
    """The result of one step of a group of n environments.

    Attributes:
        observation: Observation after the step; where an episode has ended, the first one of the next episode.
        reward: float64 (n,), that of the wrappers, if there are any.
        done: Whether the episode has ended, bool (n,).
        truncated: Whether a time limit has ended it, bool (n,).
        final: The last observation of each episode that has ended, an array of n objects; None if none has ended.
        ground_truth: Ground truth of the observation, float64 (n, entries); None if the environment has none.
        episodes: Final infos of the episodes that have ended, one dict each.
    """

    observation: NDArray[Any] | dict[str, NDArray[Any]]
    reward: NDArray[np.float64]
    done: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    final: NDArray[np.object_] | None
    ground_truth: NDArray[np.float64] | None
    episodes: list[dict[str, float]]


class Environments:
    """Groups of environments: `send` a group's actions, `receive` the result later.

    An engine process starts a step at `send`. Environments in this process step in `receive`, on their own threads: a step
    takes microseconds, less than it would take to start it from a Python thread.

    The seed of each episode is drawn from 0 to 99,999, as in the paper's training.

    Attributes:
        spec: Specification of the environment.
        groups: Number of groups.
        per_group: Environments in each group.
    """

    def __init__(
        self,
        settings: Settings,
        episode_options: EpisodeOptions | None = None,
        ranks: Ranks | None = None,
        pin_memory: bool = False,
    ) -> None:
        """Make the environments, in this process or in an engine process.

        Args:
            settings: The settings of the run.
            episode_options: Chooses the options of each episode, as for `make_vec`; only with environments in this process, since
                the replacement for a failed engine replays steps.
            ranks: The ranks of the run, each with a share of the environments; `None` for this process alone.
            pin_memory: Page-lock the memory of the results, as for `make_vec`.

        Raises:
            ValueError: A reset parameter is unknown or out of its range, the engine cannot start, or `episode_options` is given
                with an engine process.
        """
        if episode_options is not None and settings.environment.engine != "thread":
            raise ValueError(
                "episode_options needs environments in this process: --environment.engine must be thread, "
                f"got {settings.environment.engine}"
            )
        wanted, ranks = settings.environment, ranks or Ranks()
        own = ranks.share(wanted.num_envs)
        self.spec: Spec = spec(settings.env)
        self.groups, self.per_group = wanted.groups, len(own) // wanted.groups
        in_process = wanted.engine == "thread"
        arguments: dict[str, Any] = {
            "num_envs": self.per_group,
            "num_threads": wanted.num_threads or ranks.threads,
            "groups": wanted.groups,
            "seed": settings.seed,
            "seeds": TRAINING_SEEDS,
            "options": settings.options(),
            "autoreset": "same_step",
            "observation": wanted.observation,
            "state": wanted.shows_state,
            "first_env": own.start,
            "total_envs": wanted.num_envs,
            "pin_memory": pin_memory,
        }
        make = partial(make_vec, settings.env, **arguments, episode_options=episode_options)
        self._view: ViewProcess | None = None

        def start() -> EndlessVectorEnv:
            envs = serve(settings.env, **arguments)
            if settings.view:
                # A replacement engine has a new name.
                self._end_view()
                self._view = ViewProcess(envs)
                print(f"view the environments at {self._view.url}", flush=True)
            return envs

        self._engine: RecoverableEngine | None = None
        try:
            if not in_process:
                self._engine = RecoverableEngine(settings.on_engine_failure, start, make)
            self._envs: EndlessVectorEnv | RecoverableEngine | WrappedGroups = self._engine or make()
        except RuntimeError as error:  # The engine reports why it cannot start.
            raise ValueError(str(error)) from error
        self._wrapped: WrappedGroups | None = None
        if wanted.wrapper:
            try:
                self._envs = self._wrapped = WrappedGroups(settings, self._envs)
            except BaseException:
                self.close()
                raise

    def reset(self, group: int) -> StepResult:
        """Start an episode in every environment of a group."""
        observation, info = self._envs.reset(group=group)
        return self._start(observation, info)

    def send(self, actions: NDArray[np.int64], group: int) -> None:
        """Send the actions of a group's next step, int64 (n, branches), without waiting for the result."""
        self._envs.send(self.spec.batched_actions(actions), group)

    def receive(self, group: int) -> StepResult:
        """The result of a group's last `send`."""
        observation, reward, terminated, truncated, info = self._envs.recv(group)
        done = terminated | truncated
        episodes = []
        if "final_info" in info:
            # Numbers of episodes, without masks, the ground truth and the Markov state.
            every = info["final_info"].items()
            final = {key: value for key, value in every if not key.startswith("_") and value.ndim == 1}
            episodes = [{key: float(value[env]) for key, value in final.items()} for env in np.flatnonzero(done)]
        ended_by_time, last, truth = truncated & ~terminated, info.get("final_obs"), info.get("ground_truth")
        return StepResult(observation, reward, done, ended_by_time, last, truth, episodes)

    def mark(self, report: Callable[[str], None]) -> None:
        """Mark the current state as the one from which a replacement continues if the engine process fails.

        Args:
            report: Called with a line of text for each failure from now on.

        Raises:
            ValueError: A wrapper has changed, and has no `state_dict`.
        """
        self.wrapper_states()
        if self._engine is not None:
            self._engine.report = report
            self._engine.mark()

    @property
    def failure(self) -> str | None:
        """Why the engine was given up, so that the environments now run in this process; None if it was not."""
        return None if self._engine is None else self._engine.failure

    def snapshots(self) -> list[list[bytes]]:
        """Snapshots of all environments of each group, for `restore`."""
        return [[self._envs.snapshot(env, group) for env in range(self.per_group)] for group in range(self.groups)]

    def restore(self, snapshots: list[list[bytes]]) -> list[StepResult]:
        """Restore snapshots, and return the current observations of each group."""
        return [self._start(*self._envs.restore(dict(enumerate(each)), group)) for group, each in enumerate(snapshots)]

    def wrapper_states(self) -> list[dict[str, Any]] | None:
        """The states of the wrappers of each group, for a checkpoint; None without wrappers.

        Raises:
            ValueError: As for `mark`.
        """
        return None if self._wrapped is None else self._wrapped.states()

    def load_wrapper_states(self, states: list[dict[str, Any]] | None) -> None:
        """Let `restore` restore what `wrapper_states` returned, for the same settings."""
        if self._wrapped is not None:
            self._wrapped.load_states(states)

    def close(self) -> None:
        """Close the environments and end the engine process, if there is one."""
        self._end_view()
        self._envs.close()

    def __enter__(self) -> Environments:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _end_view(self) -> None:
        """Stop serving the page that shows the environments, if there is one."""
        if self._view is not None:
            self._view.end()
            self._view = None

    def _start(self, observation: Any, info: dict[str, Any]) -> StepResult:
        zeros = np.zeros(self.per_group)
        none = zeros.astype(np.bool_)
        return StepResult(observation, zeros, none, none, None, info.get("ground_truth"), [])
