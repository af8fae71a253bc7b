"""Vector environments (`gymnasium.vector.VectorEnv`), in this process or in an engine process."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.specs import Frames, Spec, options_text, spec

try:
    from gymnasium.vector import AutoresetMode as AutoresetMode
    from gymnasium.vector import VectorEnv
except ImportError as error:
    raise ImportError(
        f"vector environments need Gymnasium 1.1 or newer, got {gymnasium.__version__}: pip install 'gymnasium>=1.1'; "
        "`gymnasium.make` and Gymnasium's vector environments work with this version"
    ) from error

Options = Mapping[str, Any]
Step = tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]

#: Values of `observation`, and whether the batch contains frames and the feature observation.
OBSERVATIONS = {"rgb": (True, False), "features": (False, True), "rgb+features": (True, True)}

_MODES = {name: AutoresetMode[name.upper()] for name in _native.AUTORESET_MODES}


class EndlessVectorEnv(VectorEnv[Any, Any, NDArray[Any]]):
    """Environments of one id that step in lockstep.

    Created by `make_vec`, `serve` and `connect`. `step` returns arrays with one row per environment: observation uint8
    (n, 84, 84, 3) or as in `single_observation_space`, reward float64 (n,), terminated and truncated bool (n,), and `info`.
    Arrays are read-only views of the engine's memory that do not change while they are referenced; with `copy=True` they are
    writeable copies. `torch.from_numpy` warns about read-only arrays; `endless_gym.torch_view` does not.

    As in Gymnasium, `info` has an array for each key, and a mask under the key with a leading underscore: `ground_truth` float64
    (n, k) if the original has it; in steps that end episodes, the final infos of the original (`reward`, `length`, ...), and
    `episode` with return `r`, length `l` and seconds `t` since the environments were made. With same-step auto-reset the final
    infos are in `final_info`, and `final_obs` contains the last observation of each episode that ended.
    """

    def __init__(
        self,
        backend: _Backend,
        *,
        described: Spec,
        num_envs: int,
        frames: Frames | None,
        sections: Sequence[str],
        autoreset: AutoresetMode,
        copy: bool = False,
        copy_options: Options | None = None,
    ) -> None:
        self._backend = backend
        self._described = described
        self.num_envs = num_envs
        self.num_groups = backend.groups
        self.single_observation_space = described.observation_space(frames, "features" in sections)
        self.single_action_space = described.action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {"autoreset_mode": autoreset, "render_fps": described.render_fps, "render_modes": []}
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
        self._truth = self._index.get("ground_truth")
        self._steps = [self._index[name] for name in ("reward", "terminated", "truncated")]
        self._ends = [self._index[name] for name in ("episode_return", "episode_length", "info")]
        self._integers = [is_integer for _, is_integer in described.info]
        self._same_step = autoreset is AutoresetMode.SAME_STEP
        self._all = np.ones(num_envs, dtype=np.bool_)
        self._all.flags.writeable = False
        self._start = time.perf_counter()
        self._copy = copy
        self._options = dict(copy_options or {})
        self._changed_options = False
        self._seed: int | None = None

    def reset(  # type: ignore[override]
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Options | None = None,
        group: int | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or in those of `options["reset_mask"]`.

        Args:
            seed: Environment `i` of group `g` is seeded with `seed + g * num_envs + i`, or with item `i` of a list. `None` uses
                the seeds that the environments were made with, and after that continues with their generators.
            options: Reset parameters of these and all later episodes, which override those that the environments were made
                with; and `reset_mask`, bool (n,), the environments that start an episode. Not supported if the environments
                were made with a sequence of options.
            group: The group to reset. `None` resets all groups, and returns the observations of the first one.

        Returns:
            The observations and the info.
        """
        given = dict(options or {})
        mask = given.pop("reset_mask", None)
        text = None
        if given or self._changed_options:
            text = options_text({**self._options, **given})
            self._changed_options = bool(given)
        if group is not None or self.num_groups == 1:
            return self._start_of(self._backend.reset(group or 0, self._request(seed, mask, group or 0), text))
        requests = [self._request(seed, mask, number) for number in range(self.num_groups)]
        first, *others = (self._backend.reset(number, request, text) for number, request in enumerate(requests))
        del others
        return self._start_of(first)

    def step(self, actions: Any) -> Step:
        """Play one step of every environment.

        Args:
            actions: Integers, (n, branches) or (n,) for one branch.

        Raises:
            ValueError: The number of actions is wrong, or an action is out of range. No environment was stepped.
            EngineLost: The engine process has ended.
            TooManyBatchesHeld: Arrays of too many earlier steps are referenced; delete them, or use `copy=True`.
        """
        return self._step(self._backend.step(actions))

    def send(self, actions: Any, group: int = 0) -> None:
        """Step a group without waiting for the result, which `recv` returns. `actions` as for `step`.

        In this process the step is executed by `recv`; in an engine process it starts immediately.
        """
        self._backend.send(actions, group)

    def recv(self, group: int | None = None) -> Step:
        """Wait for the result of `send`, and return it as `step` does. `None` returns the first available group; its number is
        `info["group"]`.
        """
        number, arrays = self._backend.receive(group)
        step = self._step(arrays)
        step[4]["group"] = number
        return step

    def send_reset(self, group: int = 0, *, seed: int | None = None) -> None:
        """Reset a group without waiting for the result; `recv` returns its first observations with rewards of 0.

        Environment `i` of the group is seeded with `seed + group * num_envs + i`.
        """
        self._backend.send_reset(group, seed)

    def snapshot(self, env: int, group: int = 0) -> bytes:
        """The complete state of one environment of a group, for `restore` here or in other environments of the same id.

        Raises:
            ValueError: There is no such environment.
            RuntimeError: The environment has not been reset, or the result of the group's `send` has not been received.
        """
        return self._backend.snapshot(group, self._env(env))

    def restore(self, snapshots: Mapping[int, bytes], group: int = 0) -> tuple[Any, dict[str, Any]]:
        """Restore snapshots by environment index. All environments must have been reset at least once.

        Returns:
            The observations and the info of all environments of the group.

        Raises:
            ValueError: There is no such environment, or a value is not a snapshot of this id. Earlier snapshots are restored.
            RuntimeError: As for `snapshot`.
        """
        for env, snapshot in snapshots.items():
            self._backend.restore(group, self._env(env), snapshot)
        # A reset of no environment returns the current observations.
        return self._start_of(self._backend.reset(group, ([0] * self.num_envs, [0] * self.num_envs), None))

    def ground_truth_view(self, env: int = 0) -> NDArray[np.uint8]:
        """Ground-truth view of the original's `render()`, uint8 (336, 336, 3). Only for environments in this process."""
        return self._backend.ground_truth_view(env)

    def reconnect(self, timeout: float = 30.0) -> None:
        """Connect to an engine that replaces a lost one; the environments must then be reset."""
        self._backend.reconnect(timeout)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the connection, and end the engine if this object started it. Referenced arrays stay valid."""
        self._backend.close()

    def __enter__(self) -> EndlessVectorEnv:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _env(self, given: int) -> int:
        if not 0 <= given < self.num_envs:
            raise ValueError(f"no environment {given}: the index must be 0 to {self.num_envs - 1}")
        return given

    def _request(self, seed: int | Sequence[int | None] | None, mask: Any, group: int) -> _native.Reset | None:
        if mask is None and (seed is None or isinstance(seed, (int, np.integer))):
            return None if seed is None else int(seed)
        if mask is None:
            chosen = self._all
        else:
            chosen = np.asarray(mask)
            if chosen.dtype != np.bool_ or chosen.shape != (self.num_envs,):
                raise ValueError(
                    f"`reset_mask` must be bool of shape ({self.num_envs},), got {chosen.dtype} of shape {chosen.shape}"
                )
        seeds = seed if isinstance(seed, Sequence) else self._seeds(seed, group)
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds given for {self.num_envs} environments")
        reset = [int(wanted) * (1 if given is None else 2) for wanted, given in zip(chosen, seeds, strict=True)]
        return reset, [given or 0 for given in seeds]

    def _seeds(self, seed: int | None, group: int) -> list[int | None]:
        first = group * self.num_envs
        return [None if seed is None else seed + first + env for env in range(self.num_envs)]

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
        return {"ground_truth": arrays[self._truth], "_ground_truth": self._all}

    def _step(self, arrays: _native.Arrays) -> Step:
        arrays = self._copied(arrays)
        reward, terminated, truncated = (arrays[place] for place in self._steps)
        info = self._info(arrays)
        self._add_ends(info, arrays, terminated)
        return self._observation(arrays, self._observed), reward, terminated, truncated, info

    def _add_ends(self, info: dict[str, Any], arrays: _native.Arrays, ended: NDArray[np.bool_]) -> None:
        """Add the final infos of the episodes that this step ended to `info`."""
        returns, lengths, infos = (arrays[place] for place in self._ends)
        seconds = time.perf_counter() - self._start
        ends = _native.ended_episodes(ended, returns, lengths, infos, self._integers, seconds)
        if ends is None:
            return
        returns, lengths, times, columns = ends
        final: dict[str, Any] = {"reward": returns, "_reward": ended, "length": lengths, "_length": ended}
        for (name, _), column in zip(self._described.info, columns, strict=True):
            final[name], final[f"_{name}"] = column, ended
        info["episode"], info["_episode"] = {"r": returns, "l": lengths, "t": times}, ended
        if not self._same_step:
            info.update(final)
            return
        if "final_ground_truth" in self._index:
            final["ground_truth"] = np.where(ended[:, None], arrays[self._index["final_ground_truth"]], 0.0)
            final["_ground_truth"] = ended
        info["final_info"], info["_final_info"] = final, ended
        observations = np.full(self.num_envs, None, dtype=object)
        for env in np.flatnonzero(ended):
            parts = {key: arrays[place][env] for key, place in self._final_observed}
            observations[env] = parts if len(parts) > 1 else next(iter(parts.values()))
        info["final_obs"], info["_final_obs"] = observations, ended


class _Backend:
    """The implementation behind `EndlessVectorEnv`: in this process or in an engine process."""

    groups = 1

    def reset(self, group: int, request: _native.Reset | None, options: str | None) -> _native.Arrays:
        raise NotImplementedError

    def step(self, actions: Any) -> _native.Arrays:
        raise NotImplementedError

    def send(self, actions: Any, group: int) -> None:
        raise NotImplementedError

    def send_reset(self, group: int, seed: int | None) -> None:
        raise NotImplementedError

    def receive(self, group: int | None) -> tuple[int, _native.Arrays]:
        raise NotImplementedError

    def snapshot(self, group: int, env: int) -> bytes:
        raise NotImplementedError

    def restore(self, group: int, env: int, snapshot: bytes) -> None:
        raise NotImplementedError

    def ground_truth_view(self, env: int) -> NDArray[np.uint8]:
        raise RuntimeError("the ground-truth view needs environments in this process; use `make_vec`")

    def reconnect(self, timeout: float) -> None:
        raise RuntimeError("the environments are in this process and have no engine to reconnect to")

    def close(self) -> None:
        raise NotImplementedError


class _InProcess(_Backend):
    """Environments in this process, with one pool per group."""

    def __init__(self, pools: list[_native.Pool]) -> None:
        self._pools = pools
        self.groups = len(pools)
        self._sent: dict[int, Any] = {}

    def reset(self, group: int, request: _native.Reset | None, options: str | None) -> _native.Arrays:
        return self._group(group).reset(request, options)

    def step(self, actions: Any) -> _native.Arrays:
        return self._group(0).step(actions)

    def send(self, actions: Any, group: int) -> None:
        pool = self._group(group)
        self._send(group, lambda: pool.step(actions))

    def send_reset(self, group: int, seed: int | None) -> None:
        pool = self._group(group)
        self._send(group, lambda: pool.reset(seed))

    def _send(self, group: int, work: Any) -> None:
        self._received(group)
        self._sent[group] = work

    def receive(self, group: int | None) -> tuple[int, _native.Arrays]:
        if not self._sent or (group is not None and group not in self._sent):
            raise RuntimeError(f"nothing was sent to group {group or 0}; `send` before `recv`")
        group = next(iter(self._sent)) if group is None else group
        return group, self._sent.pop(group)()

    def snapshot(self, group: int, env: int) -> bytes:
        return self._received(group).snapshot(env)

    def restore(self, group: int, env: int, snapshot: bytes) -> None:
        self._received(group).restore(env, snapshot)

    def ground_truth_view(self, env: int) -> NDArray[np.uint8]:
        return self._group(0).ground_truth_view(env)

    def close(self) -> None:
        self._pools, self._sent = [], {}

    def _received(self, group: int) -> _native.Pool:
        """The pool of a group without pending `send`."""
        if group in self._sent:
            raise RuntimeError(f"group {group} has a pending answer; `recv` it first")
        return self._group(group)

    def _group(self, group: int) -> _native.Pool:
        if not self._pools:
            raise RuntimeError("the environments are closed")
        if not 0 <= group < len(self._pools):
            raise ValueError(f"no group {group}: the index must be 0 to {len(self._pools) - 1}")
        return self._pools[group]


class _Remote(_Backend):
    """Environments in an engine process. `engine` is the process if this object started it, else None."""

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

    def send_reset(self, group: int, seed: int | None) -> None:
        self._connected().reset(group, seed)

    def receive(self, group: int | None) -> tuple[int, _native.Arrays]:
        return self._connected().receive(group, self._timeout)

    def snapshot(self, group: int, env: int) -> bytes:
        return self._connected().snapshot(group, env, self._timeout)

    def restore(self, group: int, env: int, snapshot: bytes) -> None:
        self._connected().restore(group, env, snapshot, self._timeout)

    def reconnect(self, timeout: float) -> None:
        self._connected().reconnect(timeout)

    def close(self) -> None:
        self._connection = None
        if self._engine is not None:
            self._engine.end()

    def _connected(self) -> _native.Connection:
        if self._connection is None:
            raise RuntimeError("the environments are closed")
        return self._connection


def make_vec(
    id: str,
    num_envs: int = 1,
    num_threads: int | None = None,
    *,
    seed: int | None = None,
    seeds: range | Sequence[int] | None = None,
    options: Options | Sequence[Options] | None = None,
    autoreset: str | AutoresetMode = "next_step",
    observation: str = "rgb",
    frames: Frames | None = None,
    groups: int = 1,
    copy: bool = False,
) -> EndlessVectorEnv:
    """Make environments in this process.

    Args:
        id: Environment id, such as `Endless-MortarMayhem-v0`.
        num_envs: Environments in each group.
        num_threads: Threads that step them; `None` for one per core.
        seed: Environment `i` is seeded with `seed + i` at its first reset and then continues with its generator. `None`: entropy.
        seeds: Seeds of the episodes instead: a `range` from which each episode draws its seed, as in the paper's training with
            `range(100_000)` (`seed` then seeds the draws), or a list that is used in order.
        options: Reset parameters by the original's names: one mapping for all environments, or a sequence with one mapping per
            environment, ordered by group.
        autoreset: `next_step`, `same_step` or `disabled`, as Gymnasium defines them.
        observation: `rgb`, `features` (a short vector that describes the frame; nothing is drawn), or both as a dict:
            `rgb+features`.
        frames: Format of the frames if it differs from the original: grey, channels first, row-major, stacked.
        groups: Number of groups, for `send` and `recv`.
        copy: Return writeable copies instead of read-only views.
    """
    described, mode = spec(id), autoreset_mode(autoreset)
    frames, features = contents(observation, frames)
    # As in an engine, groups share the threads, and environments are numbered across all groups.
    threads = _native.Threads(num_threads or 0)
    pools = [
        _native.Pool(
            described.id,
            num_envs,
            threads=threads,
            options=_pool_options(options, group * num_envs, num_envs, groups),
            autoreset=_name(mode),
            first_env=group * num_envs,
            total_envs=groups * num_envs,
            seed=seed,
            seed_range=(seeds.start, seeds.stop) if isinstance(seeds, range) else None,
            seed_list=None if seeds is None or isinstance(seeds, range) else list(seeds),
            frames=frames.arguments() if frames else None,
            features=features,
            final_observation=True,
        )
        for group in range(groups)
    ]
    return EndlessVectorEnv(
        _InProcess(pools),
        described=described,
        num_envs=num_envs,
        frames=frames,
        sections=pools[0].sections(),
        autoreset=mode,
        copy=copy,
        copy_options=options if isinstance(options, Mapping) else None,
    )


def connect(service: str, *, timeout: float = 30.0, copy: bool = False, engine: Any = None) -> EndlessVectorEnv:
    """Connect to a running engine, started by `endless serve --service NAME` or by `serve`.

    Args:
        service: Name of the engine.
        timeout: Seconds to wait for the engine, and for each of its answers.
        copy: Return writeable copies instead of read-only views into shared memory.
        engine: The engine process; only used by `serve`.

    Raises:
        ConnectionError: There is no such engine, or another trainer is connected to it.
    """
    connection = _native.Connection(service, timeout)
    specification = json.loads(connection.specification())
    (options, *others) = specification["options"]
    return EndlessVectorEnv(
        _Remote(connection, specification["groups"], timeout, engine),
        described=spec(specification["id"]),
        num_envs=specification["num_envs"],
        frames=Frames.of_specification(specification["frames"]),
        sections=[section["name"] for section in specification["batch"]["sections"]],
        autoreset=_MODES[specification["autoreset"]],
        copy=copy,
        copy_options=None if others else options,
    )


def gymnasium_vec(id: str, num_envs: int = 1, render_mode: str | None = None, **kwargs: Any) -> EndlessVectorEnv:
    """Entry point of `gymnasium.make_vec`; keyword arguments are those of `make_vec`."""
    if render_mode is not None:
        raise gymnasium.error.Error(
            f"vector environments do not support render_mode, got `{render_mode}`; use `gymnasium.make` to render"
        )
    return make_vec(id, num_envs, **kwargs)


def autoreset_mode(given: str | AutoresetMode) -> AutoresetMode:
    """Convert the name of an auto-reset mode to Gymnasium's `AutoresetMode`."""
    mode = given if isinstance(given, AutoresetMode) else _MODES.get(given)
    if mode is None:
        raise ValueError(f"autoreset must be {', '.join(_MODES)}; got `{given}`")
    return mode


def contents(observation: str, frames: Frames | None) -> tuple[Frames | None, bool]:
    """Format of the frames in a batch, or None without frames; and whether it contains the feature observation."""
    if observation not in OBSERVATIONS:
        raise ValueError(f"observation must be {', '.join(OBSERVATIONS)}; got `{observation}`")
    has_frames, has_features = OBSERVATIONS[observation]
    if frames is not None and not has_frames:
        raise ValueError(f"the observation `{observation}` has no frames; frames must be None, got {frames}")
    return (frames or Frames()) if has_frames else None, has_features


def _name(mode: AutoresetMode) -> str:
    return next(name for name, known in _MODES.items() if known is mode)


def _pool_options(given: Options | Sequence[Options] | None, first: int, num_envs: int, groups: int) -> str:
    """Reset parameters of the environments of one group as JSON text for the native module."""
    if given is None or isinstance(given, Mapping):
        return options_text(given)
    if len(given) != groups * num_envs:
        raise ValueError(f"got {len(given)} mappings of reset parameters for {groups * num_envs} environments")
    return f"[{', '.join(options_text(each) for each in given[first : first + num_envs])}]"
