"""Wrappers of your own around vector environments, named by `--environment.wrapper`."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from endless_gym.create import make_vec
from endless_gym.requests.results import Step
from endless_gym.specs import spec
from endless_gym.vector import EndlessVectorEnv
from endless_gym_agents.common import own
from endless_gym_agents.environments.recovery import RecoverableEngine
from endless_gym_agents.settings import Settings

FLAG = "--environment.wrapper"


class Group(VectorEnv[Any, Any, NDArray[Any]]):
    """One group of vector environments, around which the wrappers are put.

    Attributes:
        restored: What the next `reset` returns, in place of starting episodes; None to start them.
    """

    def __init__(self, envs: EndlessVectorEnv | RecoverableEngine, group: int = 0) -> None:
        """Show the group `group` of `envs`."""
        self._envs, self._group = envs, group
        self.restored: tuple[Any, dict[str, Any]] | None = None
        for name in ("num_envs", "spec", "metadata", "render_mode", "observation_space", "action_space"):
            setattr(self, name, getattr(envs.unwrapped, name))
        self.single_observation_space = envs.unwrapped.single_observation_space
        self.single_action_space = envs.unwrapped.single_action_space

    @property
    def unwrapped(self) -> EndlessVectorEnv:  # type: ignore[override]
        """The environments of all groups."""
        return self._envs.unwrapped

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or return the restored state."""
        restored, self.restored = self.restored, None
        return restored or self._envs.reset(group=self._group, **{k: v for k, v in given.items() if v is not None})

    def step(self, actions: Any) -> Step:
        """Play one step of every environment."""
        self._envs.send(actions, self._group)
        return self._envs.recv(self._group)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environments."""
        self._envs.close()


class Observed(VectorEnv[Any, Any, NDArray[Any]]):
    """Environments that others play, without rewards and ends, for wrappers that depend on observations and actions only.

    Attributes:
        observation: What the next `reset` or `step` returns.
    """

    def __init__(self, settings: Settings, num_envs: int) -> None:
        """Stand for environments of a run."""
        described = spec(settings.env)
        self.num_envs, self.metadata = num_envs, {"autoreset_mode": AutoresetMode.DISABLED}
        self.single_observation_space = described.observation_space(None, True)
        self.single_action_space = described.action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation: Any = None

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Return the observation."""
        return self.observation, {}

    def step(self, actions: Any) -> Step:
        """Return the observation."""
        none = np.zeros(self.num_envs, np.bool_)
        return self.observation, none.astype(np.float64), none, none, {}


class WrappedGroups:
    """Groups of environments, each with wrappers of its own. The methods are those of `EndlessVectorEnv`.

    A wrapper whose attributes change while it plays must have `state_dict`, which returns numbers and NumPy arrays by name, and
    `load_state_dict`, so that checkpoints contain them.
    """

    def __init__(self, settings: Settings, envs: EndlessVectorEnv | RecoverableEngine) -> None:
        """Wrap each group of the environments.

        Raises:
            ValueError: A wrapper cannot be put around these environments; see `wrap`.
        """
        self._envs = envs
        self._groups = [Group(envs, group) for group in range(settings.environment.groups)]
        self._wrapped = [wrap(settings, group) for group in self._groups]
        self._actions: list[NDArray[np.int64] | None] = [None for _ in self._groups]
        self._observations: list[Any] = [None for _ in self._groups]
        self._states: list[dict[str, Any]] | None = None
        self._made = [[_attributes(wrapper) for wrapper in _layers(envs)] for envs in self._wrapped]

    def reset(self, *, group: int) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment of a group."""
        start: tuple[Any, dict[str, Any]] = self._wrapped[group].reset()
        self._observations[group] = start[0]
        return start

    def send(self, actions: NDArray[np.int64], group: int) -> None:
        """Keep the actions of a group for `recv`, which steps, since a wrapper has no separate calls to send and to receive."""
        self._actions[group] = actions.copy()

    def recv(self, group: int) -> Step:
        """Step a group."""
        actions, self._actions[group] = self._actions[group], None
        step: Step = self._wrapped[group].step(actions)
        self._observations[group] = step[0]
        return step

    def snapshot(self, env: int, group: int) -> bytes:
        """The state of one environment, without its wrappers'."""
        return self._envs.snapshot(env, group)

    def restore(self, snapshots: Mapping[int, bytes], group: int) -> tuple[Any, dict[str, Any]]:
        """Set the states of the environments of a group.

        The wrappers see a reset that returns the restored observations, and then their states, if `load_states` was called.
        """
        self._groups[group].restored = self._envs.restore(snapshots, group)
        observation, info = self._wrapped[group].reset()
        if self._states is not None:
            state = self._states[group]
            for wrapper, values in zip(self._stateful(group), state["wrappers"], strict=True):
                wrapper.load_state_dict(_arrays(values))
            # What the wrapper made of it depended on its state.
            observation = _arrays(state["observation"])
        self._observations[group] = observation
        return observation, info

    def states(self) -> list[dict[str, Any]]:
        """The last observations and the states of the wrappers of each group, as tensors, for a checkpoint.

        Raises:
            ValueError: A wrapper has changed, and has no `state_dict`.
        """
        for envs, made in zip(self._wrapped, self._made, strict=True):
            for wrapper, before in zip(_layers(envs), made, strict=True):
                changed = [name for name, value in _attributes(wrapper).items() if before.get(name) != value]
                if changed and not hasattr(wrapper, "state_dict"):
                    raise ValueError(
                        f"{FLAG}: {type(wrapper).__name__} changes its attribute {changed[0]} while it plays, which checkpoints "
                        "must contain; add the methods `state_dict` and `load_state_dict`"
                    )
        return [
            {"observation": _tensors(seen), "wrappers": [_tensors(each.state_dict()) for each in self._stateful(group)]}
            for group, seen in enumerate(self._observations)
        ]

    def load_states(self, states: list[dict[str, Any]] | None) -> None:
        """Let `restore` restore what `states` returned, for the same settings; `None` for the state after a reset."""
        self._states = states

    def _stateful(self, group: int) -> list[Any]:
        return [wrapper for wrapper in _layers(self._wrapped[group]) if hasattr(wrapper, "state_dict")]

    def close(self) -> None:
        """Close the environments, and drop all arrays, which would keep shared memory."""
        for envs in self._wrapped:
            envs.close()
        self._groups, self._wrapped, self._observations = [], [], []


def wrap(settings: Settings, envs: VectorEnv[Any, Any, Any]) -> Any:
    """Put the wrappers of the settings around vector environments.

    Raises:
        ValueError: A class is not a wrapper, cannot wrap these environments, or changes their number or actions.
    """
    for name in settings.environment.wrapper:
        made = own.load(FLAG, name, VectorWrapper)
        try:
            wrapped = made(envs)
        except (TypeError, ValueError, AssertionError) as error:
            raise ValueError(f"{FLAG} {name} cannot wrap the environments: {error}") from error
        for part in ("num_envs", "single_action_space"):
            had, has = getattr(envs, part), getattr(wrapped, part)
            if had != has:
                raise ValueError(f"{FLAG} {name} must keep {part}, which is {had}, got {has}")
        envs = wrapped
    return envs


@contextlib.contextmanager
def make(settings: Settings, num_envs: int, num_threads: int | None = None, **arguments: Any) -> Iterator[Any]:
    """Environments of a run in this process, with its wrappers; they are closed at the end.

    Args:
        settings: Settings of the run.
        num_envs: Number of environments.
        num_threads: Threads that step them; `None` for one per core.
        arguments: Further arguments of `make_vec`.

    Raises:
        ValueError: As for `make_vec` and `wrap`.
    """
    wanted = settings.environment
    known = {
        "options": settings.options(),
        "observation": wanted.observation,
        "state": wanted.shows_state,
        "autoreset": "same_step",
    }
    with make_vec(settings.env, num_envs, num_threads, **known | arguments) as envs:
        yield wrap(settings, envs)


def observation_space(settings: Settings) -> gymnasium.Space[Any]:
    """The observation space of one environment with the wrappers of the settings.

    Raises:
        ValueError: As for `wrap`, or the agents cannot take such an observation.
    """
    with make(settings, 1, 1) as envs:
        space: gymnasium.Space[Any] = envs.single_observation_space
    for name, part in space.items() if isinstance(space, spaces.Dict) else (("", space),):
        is_frame = name == "visual_observation" or (not name and settings.environment.observation == "rgb")
        dtype, dimensions = (np.uint8, 3) if is_frame else (np.float32, 1)
        if not isinstance(part, spaces.Box) or part.dtype != dtype or len(part.shape) != dimensions:
            raise ValueError(
                f"{FLAG} must leave observations that are uint8 (height, width, channels) in `visual_observation` and float32 "
                f"(entries,) elsewhere, got {part}{f' in `{name}`' if name else ''}"
            )
    return space


def _layers(envs: Any) -> Iterator[Any]:
    """The wrappers from the outside in."""
    while isinstance(envs, VectorWrapper):
        yield envs
        envs = envs.env


def _tensors(values: Any) -> Any:
    """Arrays and numbers, or one of them, as tensors, which a checkpoint can contain."""
    if isinstance(values, Mapping):
        return {name: _tensors(value) for name, value in values.items()}
    return torch.from_numpy(np.array(values))


def _arrays(tensors: Any) -> Any:
    """The inverse of `_tensors`."""
    if isinstance(tensors, Mapping):
        return {name: _arrays(value) for name, value in tensors.items()}
    return tensors.numpy() if tensors.dim() else tensors.item()


def _attributes(wrapper: Any) -> dict[str, Any]:
    """The attributes of a wrapper in a form that can be compared later."""
    found: dict[str, Any] = {}
    for name, value in vars(wrapper).items():
        if name != "env" and not isinstance(value, gymnasium.Space):
            try:
                found[name] = pickle.dumps(value)
            except Exception:  # Objects that cannot be pickled raise many types.
                found[name] = id(value)
    return found
