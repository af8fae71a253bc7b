"""POPGym's wrappers, for single and for vector environments, without the package `popgym`, and its classes of environments.

`RepeatPreviousEasy()` and the like are single environments, by the names of the original's classes. A class without a difficulty
takes the original's arguments, `RepeatPrevious(k=2)`.
"""

from __future__ import annotations

import copy
import inspect
import json
from enum import IntEnum
from functools import partial
from itertools import compress
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatten, flatten_space
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from endless_gym.env import Env, popgym_class
from endless_gym.specs import all_specs, json_text, spec, with_arguments
from endless_gym.vector import EndlessVectorEnv

#: Single or vector environments.
Envs = Any

_LEVELS = ("Easy", "Medium", "Hard")
#: What the ids of a class of the original start with. One class has another spelling.
_CLASSES = {
    id.removeprefix("popgym-").removesuffix("Easy-v0").replace("Cartpole", "CartPole"): id.removesuffix("Easy-v0")
    for id in all_specs()
    if id.startswith("popgym-") and id.endswith("Easy-v0")
}
#: The difficulties that have the defaults of a class, where that is not Easy.
_DEFAULTS = {"Battleship": "Medium", "Concentration": "Hard"}


def __getattr__(name: str) -> Any:
    level = next((level for level in _LEVELS if name.endswith(level)), "")
    family = name.removesuffix(level)
    if family not in _CLASSES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    made = _family(family)
    globals().update((kind.__name__, kind) for kind in made)
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *(family + level for family in _CLASSES for level in ("", *_LEVELS))})


def _family(family: str) -> list[type[Env]]:
    """The class of a family without a difficulty, and those of its difficulties."""
    ids = {level: f"{_CLASSES[family]}{level}-v0" for level in _LEVELS}
    default = spec(ids[_DEFAULTS.get(family, "Easy")])
    keyword = inspect.Parameter.POSITIONAL_OR_KEYWORD
    signature = inspect.Signature(
        [inspect.Parameter(name, keyword, default=value) for name, value in default.arguments.items()]
    )

    def general(self: Env, *args: Any, render_mode: str | None = None, **kwargs: Any) -> None:
        given = dict(signature.bind(*args, **kwargs).arguments)
        arguments = json.loads(json_text({**default.arguments, **given}))
        same = (id for id in ids.values() if spec(id).arguments == arguments)
        Env.__init__(self, next(same, None) or with_arguments(default.id, given), render_mode)

    def of(id: str) -> Any:
        def specific(self: Env, render_mode: str | None = None, **kwargs: Any) -> None:
            Env.__init__(self, with_arguments(id, kwargs), render_mode, **kwargs)

        return specific

    def kind(name: str, base: type[Env], init: Any, doc: str) -> type[Env]:
        return type(name, (base,), {"__init__": init, "__doc__": doc, "__module__": __name__})

    base = kind(family, popgym_class(), general, f"The class `{family}` of POPGym.")
    return [base, *(kind(family + level, base, of(id), f"`{id}`.") for level, id in ids.items())]


class PreviousAction(VectorWrapper):
    """Adds the previous action to observations, as POPGym's `PreviousAction`: (observation, action), for Discrete, MultiDiscrete
    and Box spaces, and Tuples of them. In the first step of an episode, the action is 0.

    Args:
        envs: A single environment, or a vector environment, whose groups, if it has several, are not stepped apart.
        previous_action: Add the previous action.
        antialias: Add a last part, 1 in the first step of an episode and otherwise 0, as POPGym's `Antialias`.
        flatten: Return arrays (n, k), in which integers are one-hot, as POPGym's `Flatten`.
    """

    def __new__(cls, envs: Envs, **added: bool) -> Any:
        return super().__new__(cls) if isinstance(envs, VectorEnv) else _Single(envs, **added)

    def __init__(
        self,
        envs: VectorEnv[Any, Any, Any],
        *,
        previous_action: bool = True,
        antialias: bool = True,
        flatten: bool = False,
    ) -> None:
        super().__init__(envs)
        space = _extended_space(envs.single_observation_space, envs.single_action_space, previous_action, antialias)
        self._is_added, self._parts = (previous_action, antialias), space.spaces
        self._flat = flatten_space(space) if flatten else None
        self.single_observation_space = space if self._flat is None else self._flat
        self.observation_space = batch_space(self.single_observation_space, envs.num_envs)
        self._mode = envs.metadata["autoreset_mode"]
        self._none = _no_action(envs.action_space)
        self._actions = self._none.copy()
        self._ended = np.zeros(envs.num_envs, np.bool_)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or in those of `options["reset_mask"]`."""
        observation, info = self.env.reset(seed=seed, options=options)
        first = (options or {}).get("reset_mask", np.ones_like(self._ended))
        self._ended = self._ended & ~first
        return self._extended(observation, first), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Play one step."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        # A copy, since the caller may reuse the array.
        self._actions = np.array(actions, self._none.dtype).reshape(self._none.shape)
        ended = terminated | truncated
        if "final_obs" in info:
            final = np.full(self.num_envs, None, dtype=object)
            for env in np.flatnonzero(info["_final_obs"]):
                final[env] = self._single(info["final_obs"][env], int(env))
            info = {**info, "final_obs": final}
        first = {AutoresetMode.NEXT_STEP: self._ended, AutoresetMode.SAME_STEP: ended}.get(self._mode)
        self._ended = ended
        return (
            self._extended(observation, np.zeros_like(ended) if first is None else first),
            reward,
            terminated,
            truncated,
            info,
        )

    def _extended(self, observation: Any, first: NDArray[np.bool_]) -> Any:
        """Observations with their actions; `first` says which are the first of an episode."""
        self._actions[first] = self._none[first]
        return self._joined(observation, self._actions.copy(), first.astype(np.int64))

    def _single(self, observation: Any, env: int) -> Any:
        """The last observation of an episode."""
        parts = observation if isinstance(observation, tuple) else (observation,)
        batch = self._joined(
            tuple(np.asarray(part)[None] for part in parts), self._actions[[env]], np.zeros(1, np.int64)
        )
        return batch[0] if self._flat is not None else tuple(part[0] for part in batch)

    def _joined(self, observation: Any, actions: NDArray[Any], first: NDArray[np.int64]) -> Any:
        parts = observation if isinstance(observation, tuple) else (observation,)
        parts = (*parts, *compress((actions, first), self._is_added))
        if self._flat is None:
            return parts
        columns = [_flattened(space, part) for space, part in zip(self._parts, parts, strict=True)]
        return np.concatenate(columns, axis=1, dtype=self._flat.dtype)


class _Single(gymnasium.Wrapper[Any, Any, Any, Any]):
    """`PreviousAction` of a single environment."""

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        *,
        previous_action: bool = True,
        antialias: bool = True,
        flatten: bool = False,
    ) -> None:
        super().__init__(env)
        self._space = _extended_space(env.observation_space, env.action_space, previous_action, antialias)
        self._is_added, self._is_flat = (previous_action, antialias), flatten
        self.observation_space = flatten_space(self._space) if flatten else self._space
        self._none = _no_action(env.action_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._extended(observation, self._none, 1), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, *rest = self.env.step(action)
        return self._extended(observation, action, 0), *rest  # type: ignore[return-value]

    def _extended(self, observation: Any, action: Any, first: int) -> Any:
        parts = observation if isinstance(observation, tuple) else (observation,)
        # A copy, since the caller may reuse the array.
        extended = (*parts, *compress((copy.copy(action), first), self._is_added))
        return flatten(self._space, extended) if self._is_flat else extended


def Antialias(envs: Envs) -> Any:  # noqa: N802 - POPGym's class
    """Adds a last part to observations, 1 in the first step of an episode and otherwise 0, unless `PreviousAction` did."""
    is_added = isinstance(envs, (PreviousAction, _Single)) and envs._is_added[1]
    return envs if is_added else PreviousAction(envs, previous_action=False)


def Flatten(envs: Envs) -> Any:  # noqa: N802 - POPGym's class
    """Makes arrays of observations that are tuples or dicts, in which integers are one-hot. Others remain as they are."""
    observed = envs.single_observation_space if isinstance(envs, VectorEnv) else envs.observation_space
    if isinstance(observed, spaces.Tuple):
        return PreviousAction(envs, previous_action=False, antialias=False, flatten=True)
    if isinstance(observed, spaces.Dict):
        if isinstance(envs, VectorEnv):
            return gymnasium.wrappers.vector.FlattenObservation(envs)
        return gymnasium.wrappers.FlattenObservation(envs)
    return envs


def DiscreteAction(envs: Envs) -> Any:  # noqa: N802 - POPGym's class
    """Makes one integer of the actions of a MultiDiscrete space, in the order of `numpy.unravel_index`.

    Raises:
        ValueError: The actions are numbers of a Box.
    """
    space = envs.single_action_space if isinstance(envs, VectorEnv) else envs.action_space
    if isinstance(space, spaces.Discrete):
        return envs
    if not isinstance(space, spaces.MultiDiscrete):
        raise ValueError(f"the action space must be Discrete or MultiDiscrete, got {space}")
    choices, flat = tuple(space.nvec.tolist()), spaces.Discrete(int(space.nvec.prod()))
    split = partial(_branches, choices)
    if isinstance(envs, VectorEnv):
        return gymnasium.wrappers.vector.TransformAction(envs, split, single_action_space=flat)
    return gymnasium.wrappers.TransformAction(envs, split, flat)


def _branches(choices: tuple[int, ...], actions: Any) -> NDArray[np.int64]:
    """The choice of each branch, in the last axis."""
    return np.stack(np.unravel_index(actions, choices), axis=-1)


class Observability(IntEnum):
    """What `Markovian` shows of the Markov state, numbered as in POPGym."""

    #: Nothing.
    PARTIAL = 0
    #: `info["state"]`.
    FULL_IN_INFO_DICT = 1
    #: The state is the observation.
    FULL = 2
    #: The observation is a dict of `obs` and `state`.
    FULL_AND_PARTIAL = 3


def Markovian(envs: Envs, observability: Observability) -> Any:  # noqa: N802 - POPGym's class
    """Adds the hidden Markov state to observations or infos. In a batch, `info["state"]` is as `make_vec` returns it.

    Args:
        envs: A single environment, or a vector environment that was made with `state=True`.
        observability: What to show; POPGym's own `Observability` will do.

    Raises:
        ValueError: The environment does not tell its state.
    """
    shown = Observability(int(observability))
    own: Any = envs.unwrapped
    space = getattr(own, "single_state_space" if isinstance(envs, VectorEnv) else "state_space", None)
    if space is None:
        hint = "; make it with state=True" if isinstance(own, EndlessVectorEnv) else ""
        raise ValueError(f"{envs} does not tell its Markov state{hint}")
    return (_Markovians if isinstance(envs, VectorEnv) else _Markovian)(envs, shown, space)


def _shown_space(observed: spaces.Space[Any], state: spaces.Space[Any], shown: Observability) -> spaces.Space[Any]:
    if shown is Observability.FULL_AND_PARTIAL:
        return spaces.Dict({"obs": observed, "state": state})
    return state if shown is Observability.FULL else observed


def _shown(observation: Any, state: Any, shown: Observability) -> Any:
    if shown is Observability.FULL_AND_PARTIAL:
        return {"obs": observation, "state": state}
    return state if shown is Observability.FULL else observation


class _Markovian(gymnasium.Wrapper[Any, Any, Any, Any]):
    def __init__(self, env: gymnasium.Env[Any, Any], shown: Observability, state: spaces.Space[Any]) -> None:
        super().__init__(env)
        self._level = shown
        self.observation_space = _shown_space(env.observation_space, state, shown)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self._extended(*self.env.reset(seed=seed, options=options))

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        observation, info = self._extended(observation, info)
        return observation, reward, terminated, truncated, info

    def _extended(self, observation: Any, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        state = self.env.get_wrapper_attr("get_state")()
        if self._level is Observability.FULL_IN_INFO_DICT:
            info = {**info, "state": state}
        return _shown(observation, state, self._level), info


class _Markovians(VectorWrapper):
    def __init__(self, envs: VectorEnv[Any, Any, Any], shown: Observability, state: spaces.Space[Any]) -> None:
        super().__init__(envs)
        self._level = shown
        self._states = envs.unwrapped._described.states  # type: ignore[attr-defined]
        self.single_observation_space = _shown_space(envs.single_observation_space, state, shown)
        self.observation_space = batch_space(self.single_observation_space, envs.num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return _shown(observation, self._states(info["state"]), self._level), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(actions)
        if "final_obs" in info and self._level >= Observability.FULL:
            final = np.full(self.num_envs, None, dtype=object)
            for env in np.flatnonzero(info["_final_obs"]):
                final[env] = _shown(info["final_obs"][env], self._states(info["final_info"]["state"][env]), self._level)
            info = {**info, "final_obs": final}
        return _shown(observation, self._states(info["state"]), self._level), reward, terminated, truncated, info


def _extended_space(observed: Any, action: spaces.Space[Any], previous_action: bool, antialias: bool) -> Any:
    """The parts of an observation, the action and the flag of a first step."""
    parts = observed.spaces if isinstance(observed, spaces.Tuple) else (observed,)
    return spaces.Tuple((*parts, *[action] * previous_action, *[spaces.Discrete(2)] * antialias))


def _no_action(space: spaces.Space[Any]) -> Any:
    """The action before the first: 0, or the bound that is nearest to 0."""
    if isinstance(space, spaces.Discrete):
        return 0
    zeros = np.zeros(space.shape or (), space.dtype)
    return zeros.clip(space.low, space.high) if isinstance(space, spaces.Box) else zeros


def _flattened(space: spaces.Space[Any], batch: NDArray[Any]) -> NDArray[Any]:
    """The rows of a batch as vectors, (n, k)."""
    if isinstance(space, spaces.Discrete):
        return _one_hot(int(space.n), batch)
    if isinstance(space, spaces.MultiDiscrete):
        columns = zip(space.nvec.flat, batch.reshape(len(batch), -1).T, strict=True)
        return np.concatenate([_one_hot(int(choices), column) for choices, column in columns], axis=1)
    return batch.reshape(len(batch), -1)


def _one_hot(choices: int, integers: NDArray[Any]) -> NDArray[np.int64]:
    one_hot: NDArray[np.int64] = (integers[:, None] == np.arange(choices)).astype(np.int64)
    return one_hot
