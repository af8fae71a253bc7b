"""Many environments as one `gymnasium.vector.VectorEnv`, in this process or in an engine process."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.arguments import MAX_U64, integer, mapping
from endless_gym.arguments import timeout as checked_timeout
from endless_gym.backends import Backend, InProcess, Reconnection, Remote
from endless_gym.configuration import (
    MODES,
    AutoresetMode,
    AutoresetName,
    Options,
    checked_arguments,
    common_options,
)
from endless_gym.meanings import documented, metadata
from endless_gym.rendering import VECTOR_MODES, SnapshotRenderer, View, checked_view
from endless_gym.specs import Frames, ObservationName, Spec, all_specs, options_text, spec

Seeds = int | Sequence[int | None] | NDArray[np.integer[Any]] | None
Step = tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


@documented(all_specs().values())
class EndlessVectorEnv(VectorEnv[Any, Any, NDArray[Any]]):
    """Environments of one id in lockstep.

    `metadata["actions"]`, `metadata["ground_truth"]` and `metadata["features"]` say what the numbers mean.

    `make_vec`, `serve` and `connect` create it. `step` returns arrays of n = `num_envs` rows: observation uint8 (n, 84, 84, 3) or
    of `single_observation_space`, reward float64 (n,), terminated and truncated bool (n,), and `info`. Observations and
    `ground_truth` are read-only views of the memory that the engine wrote; their contents do not change while references to them
    exist. With `copy=True` they are writable copies, as rewards and flags always are. `endless_gym.torch_view` returns read-only
    tensors that share their memory.

    `info` has an array for each key, and for the key with a leading underscore a mask, as in Gymnasium: `ground_truth` float64
    (n, k) if the original has it; in steps that end episodes the original's final infos: `reward`, the episode's return, float64
    (n,), `length`, its steps, int32 (n,), and the numbers of the task. With same-step auto-reset the final infos are in
    `final_info`, and `final_obs` has the last observation of each episode that ended, unless an engine was started without
    `--final-observation`.
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
        options: Options | None = None,
        render_mode: str | None = None,
        view: View | None = None,
    ) -> None:
        """Called by `make_vec` and `connect`. `options` is `None` if each environment has a mapping of its own."""
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
        self._all = np.ones(num_envs, dtype=np.bool_)
        self._all.flags.writeable = False
        self._copy = copy
        self._options = None if options is None else dict(options)
        self._changed_options = False
        self._seed: int | None = None

    def reset(  # type: ignore[override]
        self,
        *,
        seed: Seeds = None,
        options: Options | None = None,
        group: int | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or in those of `options["reset_mask"]`.

        Args:
            seed: Environment `i` of group `g` is seeded with `seed + g * num_envs + i`. Or a list or an array with a seed or
                `None` for each environment of a group, or of all groups. Later episodes follow from this seed alone. `None`
                uses the seeds given at creation for the first reset, and continues the generators afterwards.
            options: Reset parameters until the next `reset`, which override those given at creation; and `reset_mask`, bool (n,),
                the environments that start an episode. If the environments were created with one mapping each, only
                `reset_mask`.
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
        text = None
        if given and self._options is None:
            raise ValueError(
                "options must be empty or contain only reset_mask, since the environments were created with one mapping each, "
                f"got {given}"
            )
        if self._options is not None and (given or self._changed_options):
            text = options_text({**self._options, **given})
            self._changed_options = bool(given)
        if group is not None or self.num_groups == 1:
            return self._start_of(self._backend.reset(group or 0, self._request(seed, mask, group or 0), text))
        requests = [self._request(seed, mask, number) for number in range(self.num_groups)]
        batches = [self._backend.reset(number, request, text) for number, request in enumerate(requests)]
        return self._start_of(batches[0])

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
        return self._step(self._backend.step(actions))

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
        self._backend.send(actions, self._group(group))

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
        self._backend.send_reset(group, self._request(seed, None, group))

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
        # A reset of no environment returns the current observations.
        return self._start_of(self._backend.reset(group, ([0] * self.num_envs, [0] * self.num_envs), None))

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
        return self._backend.reconnect(checked_timeout(timeout))

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

    def _request(self, seed: Seeds, mask: Any, group: int) -> _native.Reset | None:
        if mask is None and not _has_items(seed):
            return None if seed is None else integer("seed", seed)
        if mask is None:
            chosen = self._all
        else:
            chosen = np.asarray(mask)
            if chosen.dtype != np.bool_ or chosen.shape != (self.num_envs,):
                raise ValueError(
                    f"reset_mask must be a bool array of shape ({self.num_envs},), got {chosen.dtype} {chosen.shape}"
                )
        seeds = self._seeds(seed, group)
        reset = [int(wanted) * (1 if given is None else 2) for wanted, given in zip(chosen, seeds, strict=True)]
        return reset, [given or 0 for given in seeds]

    def _seeds(self, seed: Seeds, group: int) -> list[int | None]:
        """One seed for each environment of a group."""
        if seed is None:
            return [None] * self.num_envs
        if not _has_items(seed):
            # Sums wrap, as in the engine.
            first = integer("seed", seed) + group * self.num_envs
            return [(first + env) & MAX_U64 for env in range(self.num_envs)]
        given: list[Any] = list(seed)
        if len(given) == self.num_envs * self.num_groups:
            given = given[group * self.num_envs :][: self.num_envs] if self.num_groups > 1 else given
        elif len(given) != self.num_envs:
            allowed = f"{self.num_envs} items, one for each environment"
            if self.num_groups > 1:
                allowed += f" of a group, or {self.num_envs * self.num_groups} for all groups"
            raise ValueError(f"seed must have {allowed}, got {len(given)}")
        return [None if each is None else integer("seed", each) for each in given]

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
    render_mode: str | None = None,
    view: View | None = None,
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
        render_mode: What `render` returns: `rgb_array` for frames, `debug_rgb_array` for ground-truth views.
        view: What `rgb_array` shows: `agent` for frames, the default, or `ground_truth` for ground-truth views.

    Raises:
        TypeError: A number is not an integer.
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
        options=common_options(options),
        render_mode=render_mode,
        view=view,
    )


def connect(
    service: str,
    *,
    timeout: float = 30.0,
    copy: bool = False,
    render_mode: str | None = None,
    view: View | None = None,
    engine: Any = None,
) -> EndlessVectorEnv:
    """Connect to a running engine, started by `endless serve --service NAME` or by `serve`.

    Args:
        service: The engine's name.
        timeout: Seconds to wait for the engine to start, and for each of its answers.
        copy: Return writable copies instead of read-only views of shared memory.
        render_mode: As for `make_vec`.
        view: As for `make_vec`.
        engine: Used by `serve`.

    Raises:
        ConnectionError: There is no such engine, or it already has a trainer.
        ValueError: The timeout is negative or not finite, or there is no such render mode or view.
    """
    timeout = checked_timeout(timeout)
    checked_view(render_mode, view, VECTOR_MODES)
    connection = _native.Connection(service, timeout)
    specification = json.loads(connection.specification())
    options = specification["options"]
    return EndlessVectorEnv(
        Remote(connection, specification["groups"], timeout, engine),
        described=spec(specification["id"]),
        num_envs=specification["num_envs"],
        frames=Frames.from_specification(specification["frames"]),
        sections=[section["name"] for section in specification["batch"]["sections"]],
        autoreset=MODES[specification["autoreset"]],
        copy=copy,
        options=options[0] if len(options) == 1 else None,
        render_mode=render_mode,
        view=view,
    )


def _has_items(seed: Seeds) -> TypeGuard[Sequence[int | None]]:
    """Whether there is a seed for each environment, instead of one for all."""
    return isinstance(seed, Sequence) or (isinstance(seed, np.ndarray) and seed.ndim > 0)
