"""Chooses options for each episode, and adds the seeds and options of running episodes to `info`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.arguments import mapping
from endless_gym.requests.configuration import AutoresetMode
from endless_gym.requests.next_options import NextOptions, Options, RunningEpisode, running_episodes
from endless_gym.requests.results import Results, Step
from endless_gym.vector import EndlessVectorEnv

#: Chooses the options of an environment's next episode. It is called with the number of the environment over all groups, the
#: number of the episode in this environment, from 0, and the final infos of the environment's last episode: `reward`, `length`,
#: ..., and `options`, what it returned for that episode; `None` for the first episode and after one that a reset cut short. It
#: returns options that override those given at creation, or `None`. With same-step auto-reset an episode begins in the step that
#: ends the previous one, so its options are chosen one episode ahead, with the infos of the last episode that has ended by then.
EpisodeOptions = Callable[[int, int, dict[str, Any] | None], "Options | None"]


def validate_episode_options(given: Any) -> EpisodeOptions | None:
    """The argument `episode_options`.

    Raises:
        TypeError: It cannot be called.
    """
    if given is not None and not callable(given):
        raise TypeError(
            f"episode_options must be a function of environment, episode and final infos, or None, got {given!r}"
        )
    return given  # type: ignore[no-any-return]


class EpisodeTracker:
    """Tracks where the episodes of one group begin and end.

    `choose` chooses their options; with `has_info`, `info` contains the seeds and options of the running ones.
    """

    def __init__(
        self,
        group: int,
        backend: _native.Backend,
        results: Results,
        options: NextOptions,
        choose: EpisodeOptions | None,
        has_info: bool,
    ) -> None:
        num_envs = results.num_envs
        self._group, self._first = group, group * num_envs
        self._backend, self._options, self._choose, self._has_info = backend, options, choose, has_info
        self._next_step = results.autoreset is AutoresetMode.NEXT_STEP
        self._same_step = results.autoreset is AutoresetMode.SAME_STEP
        # For each environment, the number of its next episode.
        self._numbers = [0] * num_envs
        # The environments whose next episode may begin in the next step and has no options yet.
        self._due: set[int] = set()
        # What `choose` returned for the next episode, and for the running one.
        self._next: dict[int, Options] = {}
        self._running: dict[int, Options] = {}
        # The final infos of the last episode of each environment, until the options of the next one are chosen.
        self._final: dict[int, dict[str, Any]] = {}
        # The environments of a reset whose result has not been received.
        self._reset_envs: Sequence[int] | None = None
        # With next-step auto-reset, the environments whose next episode begins in the next step.
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._copy = results.copy
        # The entries of `info`. The arrays are read-only and replaced instead of modified, since the caller may keep them.
        self._seeds = np.zeros(num_envs, dtype=np.uint64)
        self._has_seed = np.zeros(num_envs, dtype=np.bool_)
        self._played = np.full(num_envs, None, dtype=object)
        self._all = np.ones(num_envs, dtype=np.bool_)

    def before_reset(self, envs: Sequence[int]) -> None:
        """Called before these environments are reset."""
        self._choose_for([env for env in envs if env not in self._next])

    def after_reset(self, envs: Sequence[int], info: dict[str, Any]) -> None:
        """Called after these environments were reset."""
        self._begin(envs)
        for env in envs:
            self._final.pop(env, None)
        self._ended[envs] = False
        if self._has_info:
            self._keep(running_episodes(self._backend, self._group, envs))
            self._add(info)

    def sent_reset(self, envs: Sequence[int]) -> None:
        """Called after a reset of these environments was sent; its result is received like that of a step."""
        self._reset_envs = envs

    def before_step(self) -> None:
        """Called before the group is stepped."""
        if self._due:
            self._choose_for(sorted(self._due))

    def after_step(self, terminated: NDArray[np.bool_], info: dict[str, Any]) -> None:
        """Called with the result of the step, or of a reset that was sent."""
        if self._reset_envs is not None:
            envs, self._reset_envs = self._reset_envs, None
            self.after_reset(envs, info)
            return
        ended = np.flatnonzero(terminated).tolist()
        if self._next_step:
            began = np.flatnonzero(self._ended).tolist()
            self._ended = terminated.copy()
        else:
            began = ended if self._same_step else []
        if self._choose is not None and ended:
            self._keep_final(ended, info)
        self._begin(began)
        if self._choose is not None and self._next_step:
            self._due.update(env for env in ended if env not in self._next)
        if self._has_info:
            if "final_info" in info:
                self._add(info["final_info"])
            if began:
                self._keep(running_episodes(self._backend, self._group, began))
            self._add(info)

    def after_restore(self, envs: Sequence[int], info: dict[str, Any]) -> None:
        """Called when these environments continue other episodes."""
        running = running_episodes(self._backend, self._group, envs)
        for env, episode in running.items():
            self._final.pop(env, None)
            # The snapshot's options replace what was chosen.
            self._next.pop(env, None)
            self._running.pop(env, None)
            self._due.discard(env)
            self._ended[env] = self._next_step and episode.ended
            if self._choose is not None and (self._same_step or self._ended[env]):
                self._due.add(env)
        if self._has_info:
            self._keep(running)
            self._add(info)

    def _choose_for(self, envs: Sequence[int]) -> None:
        if self._choose is None or not envs:
            return
        chosen: dict[int, Options] = {}
        for env in envs:
            given = self._choose(self._first + env, self._numbers[env], self._final.get(env))
            chosen[env] = mapping("the result of episode_options", given)
        # Only after all calls, so that the next attempt repeats all of them if one raises.
        self._options.set(self._group, chosen)
        self._next.update(chosen)
        for env in envs:
            self._final.pop(env, None)
            self._due.discard(env)

    def _begin(self, envs: Iterable[int]) -> None:
        for env in envs:
            self._numbers[env] += 1
            self._running[env] = self._next.pop(env, {})
            self._due.discard(env)
            if self._same_step and self._choose is not None:
                # The episode after this one begins in the step that ends it.
                self._due.add(env)

    def _keep_final(self, ended: Iterable[int], info: dict[str, Any]) -> None:
        final = info["final_info"] if self._same_step else info
        names = [name for name in final if f"_{name}" in final and name not in ("ground_truth", "episode")]
        for env in ended:
            self._final[env] = {name: final[name][env].item() for name in names}
            self._final[env]["options"] = self._running.get(env, {})

    def _keep(self, running: dict[int, RunningEpisode]) -> None:
        envs = list(running)
        self._seeds, self._has_seed, self._played = self._seeds.copy(), self._has_seed.copy(), self._played.copy()
        self._seeds[envs] = np.array([episode.seed or 0 for episode in running.values()], dtype=np.uint64)
        self._has_seed[envs] = [episode.seed is not None for episode in running.values()]
        for env, episode in running.items():
            self._played[env] = episode.options

    def _add(self, info: dict[str, Any]) -> None:
        arrays = {"seed": self._seeds, "_seed": self._has_seed, "options": self._played, "_options": self._all}
        for name, array in arrays.items():
            array.flags.writeable = False
            info[name] = array.copy() if self._copy else array


class TrackedVectorEnv(EndlessVectorEnv):
    """Environments whose episodes are tracked, for `episode_options` and `episode_info`."""

    def __init__(
        self,
        backend: _native.Backend,
        results: Results,
        *,
        episode_options: EpisodeOptions | None,
        episode_info: bool,
        **arguments: Any,
    ) -> None:
        """As for `EndlessVectorEnv`, with the arguments of `make_vec`."""
        super().__init__(backend, results, **arguments)
        self._chooses = episode_options is not None
        self._trackers = [
            EpisodeTracker(group, backend, results, self._options, episode_options, episode_info)
            for group in range(backend.groups)
        ]

    def step(self, actions: Any) -> Step:
        with self._turns[0]:
            self._trackers[0].before_step()
        return super().step(actions)

    def send(self, actions: Any, group: int = 0) -> None:
        with self._turns[self._group(group)]:
            self._trackers[self._group(group)].before_step()
            super().send(actions, group)

    def set_options(
        self,
        options: Options | Sequence[Options | None],
        *,
        mask: NDArray[np.bool_] | None = None,
        group: int | None = None,
    ) -> None:
        if self._chooses:
            raise ValueError("options must not be set, since `episode_options` chooses those of each episode")
        super().set_options(options, mask=mask, group=group)

    def restore(self, snapshots: Mapping[int, bytes], group: int = 0) -> tuple[Any, dict[str, Any]]:
        start = super().restore(snapshots, group)
        self._trackers[group].after_restore(list(snapshots) or range(self.num_envs), start[1])
        return start

    def _before_reset(self, group: int, envs: Sequence[int], given: Options) -> str | None:
        self._trackers[group].before_reset(envs)
        return super()._before_reset(group, envs, given)

    def _reset(
        self, group: int, request: _native.Reset | None, mask: Any, given: Options
    ) -> tuple[Any, dict[str, Any]]:
        start = super()._reset(group, request, mask, given)
        self._trackers[group].after_reset(self._resets.envs(mask), start[1])
        return start

    def _sent_reset(self, group: int, envs: Sequence[int], given: Options, text: str | None) -> None:
        super()._sent_reset(group, envs, given, text)
        self._trackers[group].sent_reset(envs)

    def _received(self, group: int, arrays: _native.Arrays) -> Step:
        step = super()._received(group, arrays)
        self._trackers[group].after_step(step[2], step[4])
        return step
