"""Many environments as one `gymnasium.vector.VectorEnv`, in this process or in an engine process."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, NoReturn

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.arguments import integer, mapping
from endless_gym.arguments import timeout as checked_timeout
from endless_gym.display.descriptions import documented, metadata
from endless_gym.display.rendering import VECTOR_MODES, SnapshotRenderer, View, checked_view, modes_of
from endless_gym.interop import PageLocks
from endless_gym.requests.configuration import AutoresetMode, Options
from endless_gym.requests.exceptions import TooManyBatchesHeld
from endless_gym.requests.next_options import NextOptions, RunningEpisode, running_episodes
from endless_gym.requests.reset_requests import ResetRequests, Seeds
from endless_gym.requests.results import Results, Step
from endless_gym.specs import all_specs


class GroupReconnection(NamedTuple):
    """What `reconnect` found out about a group."""

    #: Batches that the group has returned in the current engine, including those before the checkpoint that it resumed from;
    #: `None` if its status cannot be read.
    step: int | None
    #: Batches that it had returned in the engine that ended; `None` if the engine is the same, or if its status cannot be read.
    lost_step: int | None
    #: What became of the last request: `none` if there was none, `pending` if `recv` can return its result, `played` if it was
    #: executed once, `not_played` if never, and `unknown` if the engine ended while it executed it.
    last_request: _native.LastRequest


class Reconnection(NamedTuple):
    """What `reconnect` found."""

    #: Whether this is another run of the engine. Otherwise the connection and the results that were not received are kept.
    restarted: bool
    #: A number that identifies the current run of the engine.
    incarnation: int
    #: One entry for each group.
    groups: list[GroupReconnection]


@documented(spec for spec in all_specs().values() if spec.frame)
class EndlessVectorEnv(VectorEnv[Any, Any, NDArray[Any]]):
    """Environments of one id in lockstep.

    Threads may call it at the same time, for example one for each group: a call waits for the calls of other threads to the same
    group. `send` and `recv` of a group belong together, so a group should be stepped by one thread. Only one thread may use
    `recv()` without a group.

    `metadata["actions"]`, `metadata["ground_truth"]` and `metadata["features"]` contain the meanings of the numbers.

    `make_vec`, `serve` and `connect` create it. `step` returns arrays of n = `num_envs` rows: observation uint8 (n, 84, 84, 3) or
    of `single_observation_space`, reward float64 (n,), terminated and truncated bool (n,), and `info`. Observations and
    `ground_truth` are read-only views of the memory that the engine wrote; their contents do not change while references to them
    exist. With `copy=True` they are writable copies, as rewards and flags always are. `endless_gym.torch_view` returns tensors
    that share their memory.

    As in Gymnasium, `info` has an array for each key, and a mask for the key with a leading underscore. `ground_truth`, float64
    (n, k), is present if the original has it. Steps that end episodes add the original's final infos: `reward`, the episode's
    return, float64 (n,), `length`, its number of steps, int32 (n,), and the metrics of the task. With same-step auto-reset the
    final infos are in `final_info`, and `final_obs` has the last observation of each episode that ended, unless an engine was
    started without `--final-observation`. With `episode_info`, `info` and `final_info` also have `seed`, uint64 (n,), whose mask
    is false for episodes that continue a generator, and `options`, an array of n dicts.
    """

    def __init__(
        self,
        backend: _native.Backend,
        results: Results,
        *,
        options: Sequence[Options] = ({},),
        knows_options: bool = True,
        render_mode: str | None = None,
        view: View | None = None,
        first_env: int = 0,
        engine: Any = None,
        locks: PageLocks | None = None,
    ) -> None:
        """Called by `make_vec` and `connect`.

        `options` are those given at creation: one mapping for all environments, or one for each of all groups. `knows_options` is
        false if the environments may have others. `engine` is the engine's process if it belongs to this object, and `locks`
        page-locks the engine's memory.
        """
        described = results.described
        modes = modes_of(described, VECTOR_MODES)
        shown = checked_view(render_mode, view, modes)
        self.render_mode = render_mode
        self._renderer = None if shown is None else SnapshotRenderer(described.id, shown)
        self._backend = backend
        self._engine = engine
        self._locks = locks
        self._results = results
        self._described = described
        #: The id's entry in Gymnasium's registry; `None` for an id that is not registered, such as one of an engine of your own.
        self.spec = described.registered()
        self.num_envs = num_envs = results.num_envs
        self.num_groups = backend.groups
        self.single_observation_space = results.observation_space
        self.single_action_space = described.action_space()
        #: The space of one environment's Markov state; `None` if `info` does not have it.
        self.single_state_space = results.state_space
        self.observation_space: gymnasium.Space[Any] = batch_space(self.single_observation_space, num_envs)
        self.action_space: gymnasium.Space[Any] = batch_space(self.single_action_space, num_envs)
        self.metadata = {
            "autoreset_mode": results.autoreset,
            "render_fps": described.render_fps,
            "render_modes": list(modes),
        }
        self.metadata.update(metadata(described))
        #: Whether `info` has the last observation of an episode that ended, with same-step auto-reset.
        self.has_final_observation = results.has_final_observation
        # A thread's call to a group waits for another thread's; a signal handler's call within a call does not.
        self._turns = [threading.RLock() for _ in range(backend.groups)]
        self._drawing = threading.Lock()
        self._has_begun = False
        # The backend keeps each result here until the caller has it, since a signal handler may raise in between. Nothing between
        # the entry's removal and the return to the caller may call a function, where Python would run the handler.
        self._kept = backend.kept
        self._resets = ResetRequests(num_envs, backend.groups, first_env)
        self._options = NextOptions(backend, num_envs, options, knows_options)

    def reset(  # type: ignore[override]
        self, *, seed: Seeds = None, options: Options | None = None, group: int | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or in those of `options["reset_mask"]`.

        Examples:
            >>> import endless_gym
            >>> envs = endless_gym.make_vec("MortarMayhem-Grid-v0", 3)
            >>> observation, info = envs.reset(seed=0, options={"command_count": [2]})
            >>> [episode.seed for episode in envs.running_episodes()]
            [0, 1, 2]

        Args:
            seed: Environment `i` of group `g` is seeded with `seed + first_env + g * num_envs + i`. Or a list or an array with a
                seed or `None` for each environment of a group, or of all groups. This seed alone determines later episodes.
                `None` uses the seeds given at creation for the first reset, and continues the generators afterwards.
            options: Reset parameters of the environments that are reset, until their next `reset` or `set_options`; they
                override those given at creation and by `set_options`. The entry `reset_mask`, bool (n,), selects the
                environments that start an episode; the others continue, and keep their options.
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

        Examples:
            >>> import endless_gym
            >>> envs = endless_gym.make_vec("MortarMayhem-Grid-v0", 3, seed=0, options={"command_count": [1]})
            >>> observation, info = envs.reset()
            >>> for _ in range(10):
            ...     observation, reward, terminated, truncated, info = envs.step([0, 0, 0])
            >>> observation.shape, terminated
            ((3, 84, 84, 3), array([ True,  True,  True]))
            >>> info["length"], info["_length"]
            (array([10, 10, 10], dtype=int32), array([ True,  True,  True]))

        Args:
            actions: Integers in the shape of `action_space`, as an array or a list: (n,) for Discrete, (n, branches) for
                MultiDiscrete.

        Returns:
            observation: (n, ...) with the shape and dtype of `observation_space`; uint8 (n, 84, 84, 3) by default, or a dict of
                such arrays.
            reward: float64 (n,).
            terminated: bool (n,). As in the original, it is set at every end of an episode of Memory Gym, also by the step limit.
            truncated: bool (n,). Set at the time limits of POPGym.
            info: Arrays with their masks, as the class describes.

        Raises:
            TypeError: The actions are not integers.
            ValueError: The actions have another shape, or one is out of its range. No environment was stepped.
            RuntimeError: The environments have not been reset, or the last `send` or `send_reset` has not been received.
            TimeoutError: A served engine did not answer in time. `recv` can still return the result.
            EngineLost: A served engine has ended; see `reconnect`.
            TooManyBatchesHeld: As for `reset`.
            KeyboardInterrupt: Ctrl-C. If the step was played, `recv` returns its result until the next request.
        """
        with self._turns[0]:
            step = self._received(0, self._backend.step(actions))
        self._kept[0] = None
        return step

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
        with self._turns[group]:
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
        wanted = range(self.num_groups) if group is None else (self._group(group),)
        kept = [(number, arrays) for number in wanted if (arrays := self._kept[number]) is not None]
        number, arrays = kept[0] if kept else self._backend.receive(None if group is None else wanted[0])
        step = self._received(number, arrays)
        step[4]["group"] = number
        self._kept[number] = None
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
        with self._turns[group]:
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
        """Set the reset parameters of the next episodes, whether they begin by auto-reset or by a reset.

        They override those given at creation, and replace those of earlier calls and of the last `reset`. Running episodes do not
        change. With same-step auto-reset the next episode begins in the step that ends the running one.

        Args:
            options: One mapping for all environments, or a sequence with one for each environment of a group, or of all groups;
                `None` in a sequence leaves an environment as it is. An empty mapping restores the options given at creation.
            mask: bool (n,), the environments of a group whose options are set; `None` for all.
            group: The group; `None` for all groups.

        Raises:
            TypeError: The options are neither a mapping nor a sequence of mappings.
            ValueError: An option is unknown or out of its range, the sequence or the mask has a wrong length, or
                `episode_options` chooses the options. Groups with a lower number have changed.
            RuntimeError: The group's last `send` or `send_reset` has not been received.
            TimeoutError: A served engine did not answer in time. The call may be repeated.
        """
        groups = range(self.num_groups) if group is None else [self._group(group)]
        with contextlib.ExitStack() as turns:
            for number in groups:
                turns.enter_context(self._turns[number])
            self._options.set_all(groups, self._resets.envs(mask, "mask"), options)

    @property
    def reset_params(self) -> list[dict[str, Any]]:
        """The reset parameters of the running episode of each environment of group 0, the defaults included; before the first
        reset, those given at creation.

        Raises:
            RuntimeError: The last `send` or `send_reset` has not been received.
        """
        if self._has_begun:
            given: Sequence[Options] = [running.options for running in self.running_episodes()]
        else:
            given = self._options.created
        return [{**self._described.reset_parameters, **each} for each in given]

    @property
    def max_episode_steps(self) -> list[int]:
        """The step limit of each environment of group 0 with its `reset_params`; -1 for none."""
        return [self._described.max_episode_steps(parameters) for parameters in self.reset_params]

    def running_episodes(self, group: int = 0) -> list[RunningEpisode]:
        """Seeds and options of a group's running episodes; see `RunningEpisode`.

        Raises:
            ValueError: There is no such group.
            RuntimeError: As for `snapshot`.
        """
        with self._turns[self._group(group)]:
            return list(running_episodes(self._backend, self._group(group), range(self.num_envs)).values())

    def snapshot(self, env: int, group: int = 0) -> bytes:
        """The complete state of one environment, which `restore` accepts for any environment of the same id.

        Examples:
            >>> import endless_gym
            >>> envs = endless_gym.make_vec("MysteryPath-Grid-v0", 4, seed=0)
            >>> observation, info = envs.reset()
            >>> start = envs.snapshot(env=0)
            >>> observation, info = envs.restore({1: start, 2: start, 3: start})
            >>> bool((observation == observation[0]).all())
            True

        Raises:
            ValueError: There is no such environment or group.
            RuntimeError: It has not been reset, or the group's last `send` or `send_reset` has not been received.
        """
        with self._turns[self._group(group)]:
            return self._backend.snapshot(self._group(group), self._env(env))

    def restore(self, snapshots: Mapping[int, bytes], group: int = 0) -> tuple[Any, dict[str, Any]]:
        """Set the states of environments of a group, all of which must have been reset once, to those of snapshots.

        Args:
            snapshots: Snapshots by environment number. They may come from other environments of the same id.
            group: The group of the environments.

        Returns:
            The observations and the info of all environments of the group.

        Raises:
            ValueError: There is no such environment or group, or a value is not a snapshot of that id. Environments before it in
                the mapping are restored.
            RuntimeError: As for `snapshot`.
        """
        group = self._group(group)
        if not isinstance(snapshots, Mapping):
            shown = f"got {type(snapshots).__name__}; pass {{env: snapshot}}"
            raise TypeError(f"snapshots must be a mapping from numbers of environments to snapshots, {shown}")
        with self._turns[group]:
            for env, snapshot in snapshots.items():
                self._backend.restore(group, self._env(env), snapshot)
                self._options.forget(group, [env])
            # Resetting no environments returns the current observations.
            arrays = self._backend.reset(group, ([0] * self.num_envs, [0] * self.num_envs), None)
            self._has_begun = True
            self._kept[group] = None
            return self._results.start(self._page_locked(group, arrays))

    def render(self, group: int = 0) -> tuple[Any, ...] | None:  # type: ignore[override]
        """A picture of each environment of a group, indexed `[row][column][channel]`, or a text; `None` without a mode.

        With `rgb_array` it is the frame, uint8 (84, 84, 3), whatever the observation; with `debug_rgb_array`, or the view
        `ground_truth`, the original's ground-truth view, uint8 (336, 336, 3). Each is drawn in this process from a snapshot,
        which does not change the environments. With same-step auto-reset, it shows the new episode, as in Gymnasium.

        Raises:
            ValueError: There is no such group.
            RuntimeError, TimeoutError, EngineLost: As for `snapshot`.
        """
        group = self._group(group)
        if self._renderer is None:
            return None
        with self._turns[group]:
            snapshots = [self._backend.snapshot(group, env) for env in range(self.num_envs)]
        with self._drawing:
            return self._renderer.render(snapshots)

    def ground_truth_view(self, env: int = 0) -> NDArray[np.uint8]:
        """The original's debug rendering of an environment of group 0, uint8 (336, 336, 3), indexed `[row][column][channel]`.

        Raises:
            RuntimeError: The environments are in another process, or have not been reset.
            ValueError: There is no such environment.
        """
        if not hasattr(self._backend, "ground_truth_view"):
            raise RuntimeError("the environments are in another process; make them with `make_vec` for this")
        with self._turns[0]:
            view: NDArray[np.uint8] = self._backend.ground_truth_view(self._env(env))
        return view

    def adopt(self, group: int = 0) -> tuple[Any, dict[str, Any]]:
        """The current observations and info of a group, without starting an episode.

        Use it to continue the episodes of an engine that resumed from a checkpoint, or of another trainer that has gone.

        Raises:
            ValueError: There is no such group.
            RuntimeError: The environments have no episodes yet, or the group's last `send` or `send_reset` has not been received.
        """
        return self.restore({}, group)

    def checkpoint(self) -> list[int]:
        """Save all environments of a served engine to its checkpoint file, and wait until it is on the disk.

        Returns:
            For each group, the number of batches that it had returned; an engine that resumes continues counting from there.

        Raises:
            RuntimeError: The engine has no checkpoint file or cannot write it, the environments are in this process or have no
                episodes yet, or the last `send` or `send_reset` of group 0 has not been received.
            TimeoutError: The engine did not answer in time.
        """
        if not isinstance(self._backend, _native.Connection):
            raise RuntimeError("the environments are in this process; use `snapshot` to save them")
        with self._turns[0]:
            return self._backend.checkpoint()

    def reconnect(self, timeout: float = 30.0) -> Reconnection:
        """Connect to the engine that replaced one that has ended. Its environments must then be reset, or adopted (`adopt`) if
        the engine resumed from a checkpoint.

        If the engine is still running, the connection is kept, and so are results that were not received: nothing is played
        twice, and `recv` returns the results of what was sent.

        Args:
            timeout: Seconds to wait for the engine to start.

        Returns:
            Whether this is another run of the engine, and for each group its step and what became of the last request.

        Raises:
            ConnectionError: There is no such engine, or it already has a trainer.
            RuntimeError: The environments are in this process.
            ValueError: The timeout is negative or not finite.
        """
        timeout = checked_timeout(timeout)
        if not isinstance(self._backend, _native.Connection):
            raise RuntimeError("the environments are in this process; there is no engine to reconnect to")
        if self._locks is not None:
            self._locks.release()
        restarted, incarnation, groups = self._backend.reconnect(timeout)
        for group in range(self.num_groups if restarted else 0):
            self._options.forget(group, range(self.num_envs))
        return Reconnection(restarted, incarnation, [GroupReconnection(*group) for group in groups])

    def close_extras(self, **kwargs: Any) -> None:
        """Disconnect, and stop the engine if `serve` started it. Arrays remain valid."""
        self._kept[:] = [None] * self.num_groups
        with contextlib.ExitStack() as last_first:
            if self._engine is not None:
                last_first.callback(self._engine.end)
            last_first.callback(self._backend.close)
            if self._locks is not None:
                last_first.callback(self._locks.release)

    def __enter__(self) -> EndlessVectorEnv:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __reduce__(self) -> NoReturn:
        """Vector environments cannot be pickled or copied: only one process and one object steps them."""
        raise TypeError(
            "vector environments cannot be pickled or copied; make them in the process that steps them, as by a function that "
            "calls `make_vec`, `serve` or `connect`, copy episodes with `snapshot` and `restore`, or pickle an `Env`"
        )

    def _env(self, given: int) -> int:
        return integer("env", given, 0, self.num_envs - 1)

    def _group(self, given: int) -> int:
        return integer("group", given, 0, self.num_groups - 1)

    def _before_reset(self, group: int, envs: Sequence[int], given: Options) -> str | None:
        return self._options.prepare(group, envs, given)

    def _reset(
        self, group: int, request: _native.Reset | None, mask: Any, given: Options
    ) -> tuple[Any, dict[str, Any]]:
        envs = self._resets.envs(mask)
        with self._turns[group]:
            text = self._before_reset(group, envs, given)
            try:
                arrays = self._page_locked(group, self._backend.reset(group, request, text))
                start = self._results.start(arrays)
            except (TimeoutError, TooManyBatchesHeld):
                # `recv` can still return the result.
                self._sent_reset(group, envs, given, text)
                raise
            except KeyboardInterrupt:
                # The same, if the reset was sent at all.
                self._sent_reset(group, envs, given, text)
                self._options.forget(group, envs)
                raise
            self._options.started(group, envs, given, text)
        self._has_begun = True
        self._kept[group] = None
        return start

    def _received(self, group: int, arrays: _native.Arrays) -> Step:
        """The result of a step, or of a reset that was sent."""
        self._has_begun = True
        return self._results.step(self._page_locked(group, arrays))

    def _page_locked(self, group: int, arrays: _native.Arrays) -> _native.Arrays:
        if self._locks is not None:
            self._locks.lock(group, arrays)
        return arrays

    def _sent_reset(self, group: int, envs: Sequence[int], given: Options, text: str | None) -> None:
        self._options.started(group, envs, given, text)


def check_adaptable(
    envs: EndlessVectorEnv | gymnasium.vector.VectorWrapper, autoreset: AutoresetMode, library: str
) -> EndlessVectorEnv:
    """Check that a library can use vector environments, and return them without their wrappers.

    Args:
        envs: The vector environments.
        autoreset: The auto-reset mode that the library requires.
        library: Its name, for messages.

    Raises:
        TypeError: They are not `EndlessVectorEnv`s.
        ValueError: The environments have another auto-reset mode, more than one group, or tuples as observations.
    """
    own = envs.unwrapped
    if not isinstance(own, EndlessVectorEnv):
        raise TypeError(f"envs must be made by make_vec, serve or connect, got {envs!r}")
    mode = AutoresetMode(envs.metadata["autoreset_mode"])
    if mode is not autoreset:
        raise ValueError(f'autoreset must be "{autoreset.name.lower()}" for {library}, got "{mode.name.lower()}"')
    if own.num_groups != 1:
        raise ValueError(f"groups must be 1 for {library}, got {own.num_groups}")
    if isinstance(envs.single_observation_space, gymnasium.spaces.Tuple):
        raise ValueError(
            f"observations must not be tuples for {library}, got {envs.single_observation_space}; flatten them with "
            "endless_gym.popgym.PreviousAction(envs, flatten=True)"
        )
    return own
