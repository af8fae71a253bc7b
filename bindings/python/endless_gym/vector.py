"""Many environments as one `gymnasium.vector.VectorEnv`, in this process or in an engine process."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.arguments import integer, mapping
from endless_gym.arguments import timeout as checked_timeout
from endless_gym.backends import Backend, InProcess, Reconnection, Remote
from endless_gym.configuration import MODES, AutoresetMode, AutoresetName, Options, checked_arguments, options_list
from endless_gym.episodes import EpisodeOptions, EpisodeTracker, RunningEpisode, checked_choice, running_episodes
from endless_gym.meanings import documented, metadata
from endless_gym.next_options import NextOptions
from endless_gym.rendering import VECTOR_MODES, SnapshotRenderer, View, checked_view
from endless_gym.reset_requests import ResetRequests, Seeds
from endless_gym.specs import Frames, ObservationName, Spec, all_specs, spec

Step = tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


@documented(all_specs().values())
class EndlessVectorEnv(VectorEnv[Any, Any, NDArray[Any]]):
    """Environments of one id in lockstep.

    `metadata["actions"]`, `metadata["ground_truth"]` and `metadata["features"]` say what the numbers mean.

    `make_vec`, `serve` and `connect` create it. `step` returns arrays of n = `num_envs` rows: observation uint8 (n, 84, 84, 3) or
    of `single_observation_space`, reward float64 (n,), terminated and truncated bool (n,), and `info`. Observations and
    `ground_truth` are read-only views of the memory that the engine wrote; their contents do not change while references to them
    exist. With `copy=True` they are writable copies, as rewards and flags always are. `endless_gym.torch_view` returns tensors
    that share their memory.

    `info` has an array for each key, and for the key with a leading underscore a mask, as in Gymnasium: `ground_truth` float64
    (n, k) if the original has it; in steps that end episodes the original's final infos: `reward`, the episode's return, float64
    (n,), `length`, its steps, int32 (n,), and the numbers of the task. With same-step auto-reset the final infos are in
    `final_info`, and `final_obs` has the last observation of each episode that ended, unless an engine was started without
    `--final-observation`. With `episode_info`, `info` and `final_info` also have what the episodes follow from: `seed` uint64
    (n,), whose mask is false for episodes that continue a generator, and `options`, an array of n dicts.
    """

    def __init__(
        self,
        backend: Backend,
        *,
        described: Spec,
        num_envs: int,
        frames: Frames | None,
        sections: Sequence[str],
        autoreset: AutoresetMode,
        copy: bool = False,
        options: Sequence[Options] = ({},),
        knows_options: bool = True,
        render_mode: str | None = None,
        view: View | None = None,
        episode_options: EpisodeOptions | None = None,
        episode_info: bool = False,
        first_env: int = 0,
    ) -> None:
        """Called by `make_vec` and `connect`.

        `options` are those given at creation: one mapping for all environments, or one for each of all groups. `knows_options` is
        false if the environments may have others.
        """
        shown = checked_view(render_mode, view, VECTOR_MODES)
        self.render_mode = render_mode
        self._renderer = None if shown is None else SnapshotRenderer(described.id, shown)
        self._backend = backend
        self._described = described
        self.num_envs = num_envs
        self.num_groups = backend.groups
        self.single_observation_space = described.observation_space(frames, "features" in sections)
        self.single_action_space = described.action_space()
        self.observation_space: gymnasium.Space[Any] = batch_space(self.single_observation_space, num_envs)
        self.action_space: gymnasium.Space[Any] = batch_space(self.single_action_space, num_envs)
        self.metadata = {
            "autoreset_mode": autoreset,
            "render_fps": described.render_fps,
            "render_modes": list(VECTOR_MODES),
        }
        self.metadata.update(metadata(described))
        self._index = {name: place for place, name in enumerate(sections)}
        names = {
            "observation": "visual_observation",
            "features": "features",
            "vector_observation": "vector_observation",
        }
        self._observed = [(key, self._index[name]) for name, key in names.items() if name in self._index]
        self._final_observed = [
            (key, self._index[f"final_{name}"]) for name, key in names.items() if f"final_{name}" in self._index
        ]
        #: Whether `info` has the last observation of an episode that ended, with same-step auto-reset.
        self.has_final_observation = bool(self._final_observed)
        self._truth = self._index.get("ground_truth")
        self._steps = [self._index[name] for name in ("reward", "terminated", "truncated")]
        self._ends = [self._index[name] for name in ("episode_return", "episode_length", "info")]
        self._integers = [is_integer for _, is_integer in described.info]
        self._same_step = autoreset is AutoresetMode.SAME_STEP
        self._resets = ResetRequests(num_envs, backend.groups, first_env)
        self._all = np.ones(num_envs, dtype=np.bool_)
        self._all.flags.writeable = False
        self._copy = copy
        self._options = NextOptions(backend, num_envs, options, knows_options)
        self._chooses = checked_choice(episode_options) is not None
        # By group; none unless episodes are followed.
        self._trackers = [
            EpisodeTracker(group, num_envs, backend, self._options, autoreset, episode_options, episode_info, copy)
            for group in range(backend.groups if self._chooses or episode_info else 0)
        ]

    def reset(  # type: ignore[override]
        self,
        *,
        seed: Seeds = None,
        options: Options | None = None,
        group: int | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or in those of `options["reset_mask"]`.

        Args:
            seed: Environment `i` of group `g` is seeded with `seed + first_env + g * num_envs + i`. Or a list or an array with a
                seed or `None` for each environment of a group, or of all groups. Later episodes follow from this seed alone.
                `None` uses the seeds given at creation for the first reset, and continues the generators afterwards.
            options: Reset parameters of the environments that are reset, until their next `reset` or `set_options`; they
                override those given at creation and by `set_options`. And `reset_mask`, bool (n,), the environments that start
                an episode. The others go on, and keep their options.
            group: The group to reset. `None` resets all groups and returns the arrays of group 0.

        Returns:
            observation: (n, ...) with the shape and dtype of `observation_space`; uint8 (n, 84, 84, 3) by default, or a dict of
                such arrays.
            info: `ground_truth` float64 (n, k) with its mask `_ground_truth`, bool (n,), if the original has it; otherwise empty.

        Raises:
            ValueError: A seed, an option or the group is out of its range. Groups with a lower number are reset.
            RuntimeError: The group's last `send` or `send_reset` has not been received.
            TimeoutError: A served engine did not answer in time. `recv` can still return the result.
            EngineLost: A served engine has ended; see `reconnect`.
            TooManyBatchesHeld: Arrays of too many earlier steps of a served engine are referenced; delete them, or use
                `copy=True`. `recv` can then return the result.
        """
        if group is not None:
            group = self._group(group)
        given = mapping("options", options)
        mask = given.pop("reset_mask", None)
        groups = range(self.num_groups) if group is None else [group]
        # All of them are checked before the first group is reset.
        requests = {number: self._resets.request(seed, mask, number) for number in groups}
        starts = [self._reset(number, request, mask, given) for number, request in requests.items()]
        return starts[0]

    def step(self, actions: Any) -> Step:
        """Play one step of every environment.

        Args:
            actions: Integers in the shape of `action_space`, as an array or a list: (n,) for Discrete, (n, branches) for
                MultiDiscrete.

        Returns:
            observation: (n, ...) with the shape and dtype of `observation_space`; uint8 (n, 84, 84, 3) by default, or a dict of
                such arrays.
            reward: float64 (n,).
            terminated: bool (n,). As in the original, it is set at every end of an episode, also at the step limit.
            truncated: bool (n,).
            info: Arrays with their masks, as the class describes.

        Raises:
            TypeError: The actions are not integers.
            ValueError: The actions have another shape, or one is out of its range. No environment was stepped.
            RuntimeError: The environments have not been reset, or the last `send` or `send_reset` has not been received.
            TimeoutError: A served engine did not answer in time. `recv` can still return the result.
            EngineLost: A served engine has ended; see `reconnect`.
            TooManyBatchesHeld: As for `reset`.
        """
        if not self._trackers:
            return self._step(self._backend.step(actions))
        self._trackers[0].before_step()
        return self._followed(0, self._step(self._backend.step(actions)))

    def send(self, actions: Any, group: int = 0) -> None:
        """Step a group without waiting for the result, which `recv` returns.

        The actions are copied. An engine steps at once; environments in this process are stepped by `recv`.

        Args:
            actions: As for `step`.
            group: The group to step.

        Raises:
            TypeError: As for `step`.
            ValueError: As for `step`, or there is no such group.
            RuntimeError: The group's last `send` or `send_reset` has not been received.
        """
        group = self._group(group)
        if self._trackers:
            self._trackers[group].before_step()
        self._backend.send(actions, group)

    def recv(self, group: int | None = None) -> Step:
        """Wait for the result of a group's `send` or `send_reset`, and return it as `step` does.

        Args:
            group: The group to wait for; `None` waits for any.

        Returns:
            observation, reward, terminated, truncated, info: As for `step`. `info["group"]` is the number of the group, an int.

        Raises:
            ValueError: There is no such group.
            RuntimeError: Nothing was sent to the group, or it was stepped before its first reset.
            TimeoutError: A served engine did not answer in time. The result can still be received.
            EngineLost: A served engine has ended; see `reconnect`.
            TooManyBatchesHeld: As for `reset`. The result can still be received.
        """
        number, arrays = self._backend.receive(None if group is None else self._group(group))
        step = self._step(arrays)
        step[4]["group"] = number
        if self._trackers:
            self._followed(number, step)
        return step

    def send_reset(self, group: int = 0, *, seed: Seeds = None) -> None:
        """Reset a group without waiting for the result; `recv` returns its first observations with rewards of 0.

        Args:
            group: The group to reset.
            seed: As for `reset`.

        Raises:
            ValueError: The seed is out of its range, or there is no such group.
            RuntimeError: The group's last `send` or `send_reset` has not been received.
        """
        group = self._group(group)
        request, envs = self._resets.request(seed, None, group), range(self.num_envs)
        text = self._before_reset(group, envs, {})
        self._backend.send_reset(group, request, text)
        self._sent_reset(group, envs, {}, text)

    def set_options(
        self,
        options: Options | Sequence[Options | None],
        *,
        mask: NDArray[np.bool_] | None = None,
        group: int | None = None,
    ) -> None:
        """Set the reset parameters of the next episodes, however these begin: by auto-reset or by a reset.

        They override those given at creation, and replace those of earlier calls and of the last `reset`. Running episodes do not
        change. With same-step auto-reset the next episode begins in the step that ends the running one.

        Args:
            options: One mapping for all environments, or a sequence with one for each environment of a group, or of all groups;
                `None` in a sequence leaves an environment as it is. An empty mapping returns to the options of creation.
            mask: bool (n,), the environments of a group whose options are set; `None` for all.
            group: The group; `None` for all groups.

        Raises:
            TypeError: The options are neither a mapping nor a sequence of mappings.
            ValueError: An option is unknown or out of its range, the sequence or the mask has a wrong length, or
                `episode_options` chooses the options. Groups with a lower number have changed.
            RuntimeError: The group's last `send` or `send_reset` has not been received.
            TimeoutError: A served engine did not answer in time. The call may be repeated.
        """
        if self._chooses:
            raise ValueError("options must not be set, since `episode_options` chooses those of each episode")
        groups = range(self.num_groups) if group is None else [self._group(group)]
        self._options.set_all(groups, self._resets.envs(mask, "mask"), options)

    def running_episodes(self, group: int = 0) -> list[RunningEpisode]:
        """What the running episodes of a group's environments follow from: seeds and options; see `RunningEpisode`.

        Raises:
            ValueError: There is no such group.
            RuntimeError: As for `snapshot`.
        """
        return list(running_episodes(self._backend, self._group(group), range(self.num_envs)).values())

    def snapshot(self, env: int, group: int = 0) -> bytes:
        """The complete state of one environment, which `restore` accepts for any environment of the same id.

        Raises:
            ValueError: There is no such environment or group.
            RuntimeError: It has not been reset, or the group's last `send` or `send_reset` has not been received.
        """
        return self._backend.snapshot(self._group(group), self._env(env))

    def restore(self, snapshots: Mapping[int, bytes], group: int = 0) -> tuple[Any, dict[str, Any]]:
        """Set the states of environments of a group, all of which must have been reset once, to those of snapshots.

        Args:
            snapshots: Snapshots by the number of the environment, also of other environments of the same id.
            group: The group of the environments.

        Returns:
            The observations and the info of all environments of the group.

        Raises:
            ValueError: There is no such environment or group, or a value is not a snapshot of that id. Environments before it in
                the mapping are restored.
            RuntimeError: As for `snapshot`.
        """
        group = self._group(group)
        for env, snapshot in snapshots.items():
            self._backend.restore(group, self._env(env), snapshot)
            self._options.forget(group, [env])
        # A reset of no environment returns the current observations.
        start = self._start_of(self._backend.reset(group, ([0] * self.num_envs, [0] * self.num_envs), None))
        if self._trackers:
            self._trackers[group].after_restore(list(snapshots) or range(self.num_envs), start[1])
        return start

    def render(self, group: int = 0) -> tuple[NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """A picture of each environment of a group, indexed `[row][column][channel]`; `None` without a render mode.

        With `rgb_array` the frame, uint8 (84, 84, 3), whatever the observation; with `debug_rgb_array`, or the view
        `ground_truth`, the original's ground-truth view, uint8 (336, 336, 3). Each is drawn in this process, from a snapshot, so
        that the environments stay as they are. With same-step auto-reset, it shows the new episode, as everywhere in Gymnasium.

        Raises:
            ValueError: There is no such group.
            RuntimeError, TimeoutError, EngineLost: As for `snapshot`.
        """
        group = self._group(group)
        if self._renderer is None:
            return None
        return self._renderer.render(self._backend.snapshot(group, env) for env in range(self.num_envs))

    def ground_truth_view(self, env: int = 0) -> NDArray[np.uint8]:
        """The original's debug rendering of an environment of group 0, uint8 (336, 336, 3), indexed `[row][column][channel]`.

        Raises:
            RuntimeError: The environments are in another process, or have not been reset.
            ValueError: There is no such environment.
        """
        return self._backend.ground_truth_view(self._env(env))

    def adopt(self, group: int = 0) -> tuple[Any, dict[str, Any]]:
        """The current observations and info of a group, without starting an episode.

        The episodes of an engine that resumed from a checkpoint, or that another trainer left, go on from there.

        Raises:
            ValueError: There is no such group.
            RuntimeError: The environments have no episodes yet, or the group's last `send` or `send_reset` has not been received.
        """
        return self.restore({}, group)

    def checkpoint(self) -> list[int]:
        """Save all environments of a served engine to its checkpoint file, and wait until it is on the disk.

        Returns:
            For each group the number of batches that it had returned; an engine that resumes counts on from there.

        Raises:
            RuntimeError: The engine has no checkpoint file or cannot write it, the environments are in this process or have no
                episodes yet, or the last `send` or `send_reset` of group 0 has not been received.
            TimeoutError: The engine did not answer in time.
        """
        return self._backend.checkpoint()

    def reconnect(self, timeout: float = 30.0) -> Reconnection:
        """Connect to an engine that replaces an engine that has ended. Its environments must then be reset, or
        adopted (`adopt`) if the engine resumed from a checkpoint.

        If the engine is running, the connection is kept, and so are results that were not received: nothing is played twice, and
        `recv` returns what was sent.

        Args:
            timeout: Seconds to wait for the engine to start.

        Returns:
            Whether the engine is another run, and for each group its step and what became of the last request.

        Raises:
            ConnectionError: There is no such engine, or it already has a trainer.
            RuntimeError: The environments are in this process.
            ValueError: The timeout is negative or not finite.
        """
        found = self._backend.reconnect(checked_timeout(timeout))
        for group in range(self.num_groups if found.restarted else 0):
            self._options.forget(group, range(self.num_envs))
        return found

    def close_extras(self, **kwargs: Any) -> None:
        """Disconnect, and stop the engine if `serve` started it. Arrays remain valid."""
        self._backend.close()

    def __enter__(self) -> EndlessVectorEnv:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _env(self, given: int) -> int:
        return integer("env", given, 0, self.num_envs - 1)

    def _group(self, given: int) -> int:
        return integer("group", given, 0, self.num_groups - 1)

    def _before_reset(self, group: int, envs: Sequence[int], given: Options) -> str | None:
        if self._trackers:
            self._trackers[group].before_reset(envs)
        return self._options.prepare(group, envs, given)

    def _reset(
        self, group: int, request: _native.Reset | None, mask: Any, given: Options
    ) -> tuple[Any, dict[str, Any]]:
        envs = self._resets.envs(mask)
        text = self._before_reset(group, envs, given)
        try:
            start = self._start_of(self._backend.reset(group, request, text))
        except (TimeoutError, _native.TooManyBatchesHeld):
            # `recv` can still return the result.
            self._sent_reset(group, envs, given, text)
            raise
        self._options.started(group, envs, given, text)
        if self._trackers:
            self._trackers[group].after_reset(envs, start[1])
        return start

    def _sent_reset(self, group: int, envs: Sequence[int], given: Options, text: str | None) -> None:
        self._options.started(group, envs, given, text)
        if self._trackers:
            self._trackers[group].sent_reset(envs)

    def _followed(self, group: int, step: Step) -> Step:
        self._trackers[group].after_step(step[2], step[4])
        return step

    def _observation(self, arrays: _native.Arrays, places: list[tuple[str, int]]) -> Any:
        if len(places) == 1:
            return arrays[places[0][1]]
        return {key: arrays[place] for key, place in places}

    def _copied(self, arrays: _native.Arrays) -> _native.Arrays:
        return tuple(array.copy() for array in arrays) if self._copy else arrays

    def _start_of(self, arrays: _native.Arrays) -> tuple[Any, dict[str, Any]]:
        arrays = self._copied(arrays)
        return self._observation(arrays, self._observed), self._info(arrays)

    def _info(self, arrays: _native.Arrays) -> dict[str, Any]:
        if self._truth is None:
            return {}
        return {"ground_truth": arrays[self._truth], "_ground_truth": self._all.copy() if self._copy else self._all}

    def _step(self, arrays: _native.Arrays) -> Step:
        arrays = self._copied(arrays)
        reward, terminated, truncated = (arrays[place] for place in self._steps)
        info = self._info(arrays)
        self._add_ends(info, arrays, terminated)
        return self._observation(arrays, self._observed), reward, terminated, truncated, info

    def _add_ends(self, info: dict[str, Any], arrays: _native.Arrays, ended: NDArray[np.bool_]) -> None:
        """Adds the infos of the episodes that this step ended, if it ended any."""
        returns, lengths, infos = (arrays[place] for place in self._ends)
        ends = _native.ended_episodes(ended, returns, lengths, infos, self._integers)
        if ends is None:
            return
        ended, returns, lengths, columns = ends
        final: dict[str, Any] = {"reward": returns, "_reward": ended, "length": lengths, "_length": ended}
        for (name, _), column in zip(self._described.info, columns, strict=True):
            final[name], final[f"_{name}"] = column, ended
        if not self._same_step:
            info.update(final)
            return
        if "final_ground_truth" in self._index:
            final["ground_truth"] = np.where(ended[:, None], arrays[self._index["final_ground_truth"]], 0.0)
            final["_ground_truth"] = ended
        info["final_info"], info["_final_info"] = final, ended
        if not self.has_final_observation:
            return
        observations = np.full(self.num_envs, None, dtype=object)
        for env in np.flatnonzero(ended):
            parts = {key: arrays[place][env] for key, place in self._final_observed}
            observations[env] = parts if len(parts) > 1 else next(iter(parts.values()))
        info["final_obs"], info["_final_obs"] = observations, ended


def make_vec(
    id: str,
    num_envs: int = 1,
    num_threads: int | None = None,
    *,
    seed: int | None = None,
    seeds: range | Sequence[int] | None = None,
    options: Options | Sequence[Options] | None = None,
    autoreset: AutoresetName | AutoresetMode = "next_step",
    observation: ObservationName = "rgb",
    frames: Frames | None = None,
    groups: int = 1,
    copy: bool = False,
    independent_episodes: bool = False,
    first_env: int = 0,
    total_envs: int | None = None,
    render_mode: str | None = None,
    view: View | None = None,
    episode_options: EpisodeOptions | None = None,
    episode_info: bool = False,
) -> EndlessVectorEnv:
    """Create environments in this process.

    Args:
        id: Environment id, such as `Endless-MortarMayhem-v0`.
        num_envs: Environments in each group.
        num_threads: Threads that step environments; `None` or 0 for one per core.
        seed: Environment `i`, numbered over all groups, is seeded with `seed + i` at its first reset; later episodes continue its
            generator. `None` takes entropy from the operating system.
        seeds: Seeds of the single episodes: a `range`, with any step, to draw from, as the training in the paper does from
            `range(100_000)`, with draws seeded by `seed`; or a list, used in order and repeated.
        options: Reset parameters by the original's names: one mapping for all environments, or a sequence with one for each
            environment of all groups.
        autoreset: Gymnasium's auto-reset mode: `next_step`, `same_step` or `disabled`.
        observation: `rgb` for frames, `features` for a vector that describes what the frame shows, without drawing it, or
            `rgb+features` for a dict of both.
        frames: Format of the frames: grayscale, channels first, row-major, stacked. `None` for the original's format.
        groups: Groups of environments for `send` and `recv`, 1 to 64.
        copy: Return writable copies instead of read-only views.
        independent_episodes: Start every episode as in a new environment, so that it depends on its seed and its reset parameters
            alone, and draw a seed for each episode that has none of its own. By default, as in the original, the first frames of
            an episode of Endless-MortarMayhem show the last episode's character, an episode of Searing Spotlights may start with
            the last one's background, and an episode continues the generator that the one before has drawn from.
        first_env: Number of the first environment, for seeds, if the environments of one trainer are divided among several calls,
            for example one for each rank of a data-parallel run: environment `i` is numbered `first_env + i`.
        total_envs: Environments of all of these calls together; `None` for `first_env` and those of this call.
        render_mode: What `render` returns: `rgb_array` for frames, `debug_rgb_array` for ground-truth views.
        view: What `rgb_array` shows: `agent` for frames, the default, or `ground_truth` for ground-truth views.
        episode_options: Chooses the options of each episode, see `endless_gym.episodes.EpisodeOptions`. It is called between two
            steps, before the one in which the episode may begin: with same-step auto-reset one episode ahead.
        episode_info: Whether `info` has the seed and the options of each running episode.

    Raises:
        TypeError: A number is not an integer, or `episode_options` cannot be called.
        ValueError: An argument is out of its range.
    """
    given = checked_arguments(
        id,
        num_envs,
        num_threads,
        groups,
        seed,
        seeds,
        options,
        autoreset,
        observation,
        frames,
        independent_episodes,
        first_env,
        total_envs,
    )
    # As in an engine, groups share threads.
    threads = _native.Threads(given.num_threads)
    pools = [_native.Pool(config, group, threads) for group, config in enumerate(given.pools)]
    return EndlessVectorEnv(
        InProcess(pools),
        described=given.described,
        num_envs=given.num_envs,
        frames=given.frames,
        sections=pools[0].sections(),
        autoreset=given.autoreset,
        copy=copy,
        options=options_list(options),
        render_mode=render_mode,
        view=view,
        episode_options=episode_options,
        episode_info=episode_info,
        first_env=first_env,
    )


def specified_envs(backend: Backend, specification: Mapping[str, Any], **arguments: Any) -> EndlessVectorEnv:
    """The environments of an engine with that specification; further arguments are passed to `EndlessVectorEnv`."""
    return EndlessVectorEnv(
        backend,
        described=spec(specification["id"]),
        num_envs=specification["num_envs"],
        frames=Frames.from_specification(specification["frames"]),
        sections=[section["name"] for section in specification["batch"]["sections"]],
        autoreset=MODES[specification["autoreset"]],
        first_env=specification["first_env"],
        **arguments,
    )


def connect(
    service: str,
    *,
    timeout: float = 30.0,
    copy: bool = False,
    render_mode: str | None = None,
    view: View | None = None,
    episode_options: EpisodeOptions | None = None,
    episode_info: bool = False,
    engine: Any = None,
) -> EndlessVectorEnv:
    """Connect to a running engine, started by `endless serve --service NAME` or by `serve`.

    Args:
        service: The engine's name.
        timeout: Seconds to wait for the engine to start, and for each of its answers.
        copy: Return writable copies instead of read-only views of shared memory.
        render_mode: As for `make_vec`.
        view: As for `make_vec`.
        episode_options: As for `make_vec`. It is called in this process; options that differ from the environment's last ones
            are sent to the engine before the next step.
        episode_info: As for `make_vec`. Each step in which episodes begin asks the engine for them, which needs one of its
            `batches_held`.
        engine: Used by `serve`.

    Raises:
        ConnectionError: There is no such engine, or it already has a trainer.
        ValueError: The timeout is negative or not finite, or there is no such render mode or view.
    """
    timeout = checked_timeout(timeout)
    checked_view(render_mode, view, VECTOR_MODES)
    connection = _native.Connection(service, timeout)
    specification = json.loads(connection.specification())
    return specified_envs(
        Remote(connection, specification["groups"], timeout, engine),
        specification,
        copy=copy,
        options=specification["options"],
        # An earlier trainer may have changed them, or a checkpoint.
        knows_options=False,
        render_mode=render_mode,
        view=view,
        episode_options=episode_options,
        episode_info=episode_info,
    )
