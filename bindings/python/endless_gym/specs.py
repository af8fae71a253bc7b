"""The specification of each environment id: spaces, reset parameters, infos."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.arguments import integer

#: The environment id that programs use by default.
DEFAULT_ENV_ID = _native.DEFAULT_ENV_ID

#: The kinds of observations.
ObservationName = Literal["rgb", "features", "rgb+features"]

#: For each value of the argument `observation`, whether the batch has frames and whether it has features.
OBSERVATIONS: dict[ObservationName, tuple[bool, bool]] = {
    "rgb": (True, False),
    "features": (False, True),
    "rgb+features": (True, True),
}


@dataclass(frozen=True)
class Frames:
    """The format of the frames of an observation. The default is the original's: uint8 (84, 84, 3), indexed `[x][y][channel]`.

    The engine writes this format directly, without a conversion, and only the pixels that change.

    Examples:
        >>> import endless_gym
        >>> envs = endless_gym.make_vec("MysteryPath-v0", 8, frames=endless_gym.Frames(grayscale=True, stack=4))
        >>> envs.observation_space.shape
        (8, 4, 84, 84)
    """

    #: Grayscale without a channel axis, like Gymnasium's `GrayscaleObservation`.
    grayscale: bool = False
    #: The channel is the first axis of a frame, as in PyTorch's convolutions.
    channels_first: bool = False
    #: Indexed `[row][column]` instead of `[x][y]`.
    row_major: bool = False
    #: Number of stacked frames, 1 to 64: the last frames of the episode, oldest first, padded with the episode's first frame.
    #: A stack of more than 1 adds a leading axis, like Gymnasium's `FrameStackObservation`.
    stack: int = 1

    def shape(self, size: tuple[int, int, int] = (84, 84, 3)) -> tuple[int, ...]:
        """Shape of one environment's observation, for frames of a width, a height and a number of channels."""
        return tuple(_native.frame_shape(json_text(self.configuration()), size))

    def configuration(self) -> dict[str, Any]:
        """The JSON object of the engine's `Frames`.

        Raises:
            ValueError: The stack is negative.
        """
        order = {name: bool(getattr(self, name)) for name in ("grayscale", "channels_first", "row_major")}
        return {"format": order, "stack": integer("stack", self.stack)}

    @staticmethod
    def from_specification(described: dict[str, Any] | None) -> Frames | None:
        """The format of the frames in an engine's specification; `None` without frames."""
        return None if described is None else Frames(**described["format"], stack=described["stack"])


class Meaning(NamedTuple):
    """What a number of an action or an entry of a vector means."""

    #: Name, unique within its branch or vector.
    name: str
    #: Meaning and unit.
    description: str


class ActionBranch(NamedTuple):
    """One branch of an action."""

    #: Name, unique within the environment.
    name: str
    #: What each number means, from 0 on.
    choices: tuple[Meaning, ...]


class Metric(NamedTuple):
    """The number of an episode by which agents are compared."""

    #: Its name: `reward`, `length` or a final info.
    name: str
    #: Label in plots.
    label: str


class Learnt(NamedTuple):
    """When a task counts as learnt: the mean of a number over the last episodes reaches a share of the best possible one."""

    #: Its name, as in `Metric`. A task without a final info of that name never counts as learnt.
    name: str
    #: The least mean.
    mean: float


class StatePart(NamedTuple):
    """A part of the Markov state."""

    #: Name, unique within the environment.
    name: str
    #: Meaning and unit.
    description: str
    #: The space of its numbers as the engine describes it.
    space: str | dict[str, Any]
    #: Its shape; empty for one number.
    shape: tuple[int, ...]
    #: Its type in a single environment: a dtype of numpy, or `int` for an integer of Python.
    dtype: str

    @property
    def width(self) -> int:
        """How many numbers it has."""
        return math.prod(self.shape)

    def gymnasium_space(self) -> gymnasium.Space[Any]:
        """Its space in Gymnasium."""
        if isinstance(self.space, str):
            return spaces.MultiBinary(self.shape[0])
        if "Integers" in self.space:
            choices = self.space["Integers"]
            return spaces.MultiDiscrete(np.full(self.shape, choices)) if self.shape else spaces.Discrete(choices)
        low, high = (np.resize(_bounds(self.space["Box"], bound), self.shape) for bound in ("low", "high"))
        return spaces.Box(low, high, dtype=np.float32)

    def values(self, numbers: NDArray[np.float32], dtype: str | None = None) -> NDArray[Any]:
        """Numbers (..., width) with its shape and its dtype, or that of its space."""
        if dtype is None:
            # The dtypes of Gymnasium's MultiBinary, Discrete and MultiDiscrete, and Box.
            kind = self.space if isinstance(self.space, str) else next(iter(self.space))
            dtype = {"Binary": "int8", "Integers": "int64", "Box": "float32"}[kind]
        return numbers.astype(dtype).reshape(numbers.shape[:-1] + self.shape)


class OriginalTypes(NamedTuple):
    """Types of the Python class that an environment reproduces."""

    #: numpy's dtype of arrays of integers in observations.
    integers: str
    #: The type of rewards, such as `float`.
    reward: str
    #: The names of the final infos that are floats of numpy.
    numpy_floats: Sequence[str]


@dataclass(frozen=True)
class Spec:
    """The specification of an environment id."""

    id: str
    summary: str
    #: The action space as the engine describes it.
    described_actions: dict[str, Any]
    #: What the numbers of each branch mean: `actions[branch].choices[number]`.
    actions: tuple[ActionBranch, ...]
    #: Width, height and channels of a frame; `None` if the environment has features only.
    frame: tuple[int, int, int] | None
    #: Width, height and channels of the picture for people of an environment without frames; `None` if there is none.
    picture: tuple[int, int, int] | None
    #: Length of the vector observation; 0 without one.
    vector_observation: int
    #: Length of `info["ground_truth"]`; 0 without one.
    ground_truth: int
    #: What its numbers mean.
    ground_truth_columns: tuple[Meaning, ...]
    #: Whether a single environment of the original returns `info["ground_truth"]` as an int array.
    ground_truth_is_integer: bool
    #: The least and the largest of its numbers.
    ground_truth_bounds: tuple[float, float]
    #: The parts of the Markov state; empty if the environment does not tell it.
    markov_state: tuple[StatePart, ...]
    #: Whether the best policy needs the previous action, which the observation does not show.
    needs_previous_action: bool
    #: Types of the Python class that the environment reproduces.
    types: OriginalTypes
    #: Names of the final infos besides `reward` and `length`, and whether the original's value is an int.
    info: tuple[tuple[str, bool], ...]
    #: Names of the feature observation's columns.
    features: tuple[str, ...]
    #: The space of the features as the engine describes it; `None` for a box without bounds.
    described_features: dict[str, Any] | None
    #: What its numbers mean.
    feature_columns: tuple[Meaning, ...]
    #: Reset parameters with their defaults.
    reset_parameters: dict[str, Any]
    #: Arguments of the id with its values.
    arguments: dict[str, Any]
    #: The number by which agents are compared.
    metric: Metric
    #: When the task counts as learnt; `None` for a task whose episodes get longer the better the agent is.
    learnt: Learnt | None
    render_fps: int
    #: Name of the native module that plays the environment.
    module: str = _native.__name__

    @property
    def shown(self) -> tuple[int, int, int] | None:
        """Size of what people see: the frame, or the picture of an environment without frames."""
        return self.frame or self.picture

    @property
    def native(self) -> ModuleType:
        """The native module that plays the environment."""
        return import_module(self.module)

    @property
    def full_id(self) -> str:
        """The id with which any process finds the environment: for one of your own `package:id`, otherwise the id."""
        return (
            self.id if self.module == _native.__name__ else f"{self.module.rpartition('.')[0] or self.module}:{self.id}"
        )

    def registered(self) -> gymnasium.envs.registration.EnvSpec | None:
        """A copy of the id's entry in Gymnasium's registry; `None` for an id that is not registered."""
        entry = deepcopy(gymnasium.registry.get(f"EndlessGym/{self.id.partition('?')[0]}"))
        if entry is not None:
            entry.kwargs["env_id"] = self.full_id
        return entry

    @property
    def default_observation(self) -> ObservationName:
        """The observation that an environment has unless another is requested: frames if there are any."""
        return "features" if self.frame is None else "rgb"

    @property
    def branches(self) -> tuple[int, ...]:
        """Number of choices of each branch of the action space; none for a Box."""
        described = self.described_actions
        return (described["Discrete"],) if "Discrete" in described else tuple(described.get("MultiDiscrete", ()))

    @property
    def multi_discrete(self) -> bool:
        """Whether the action space is MultiDiscrete."""
        return "MultiDiscrete" in self.described_actions

    def action_space(self) -> gymnasium.Space[Any]:
        """The action space."""
        return _space(self.described_actions)

    def batched_actions(self, actions: NDArray[np.int64]) -> NDArray[Any]:
        """The engine's actions, (n, branches) or the bits of (n, dimensions), as those of a vector environment."""
        if "Box" in self.described_actions:
            return actions.astype(np.int32).view(np.float32)
        return actions if self.multi_discrete else actions[:, 0]

    def random_actions(self, generator: np.random.Generator, n: int) -> NDArray[np.int64]:
        """Uniformly random actions of the engine, (n, branches) or the bits of (n, dimensions).

        An infinite bound of a Box is replaced by one that is 1000 away from the other, or from 0 if both are infinite.
        """
        space = self.action_space()
        if not isinstance(space, spaces.Box):
            return generator.integers(self.branches, size=(n, len(self.branches)))
        low = np.where(np.isfinite(space.low), space.low, np.where(np.isfinite(space.high), space.high - 1000, -1000))
        high = np.where(np.isfinite(space.high), space.high, np.where(np.isfinite(space.low), space.low + 1000, 1000))
        return generator.uniform(low, high, (n, *space.shape)).astype(np.float32).view(np.int32).astype(np.int64)

    def observation_space(self, frames: Frames | None = Frames(), features: bool = False) -> gymnasium.Space[Any]:
        """The original's observation space, or with the feature observation instead of or beside the frames."""
        parts: dict[str, gymnasium.Space[Any]] = {}
        if frames is not None and self.frame is not None:
            parts["visual_observation"] = spaces.Box(0, 255, frames.shape(self.frame), np.uint8)
        if features or self.frame is None:
            parts["features"] = self.feature_space()
        if self.vector_observation:
            parts["vector_observation"] = spaces.Box(0, 1, (self.vector_observation,), np.float32)
        return spaces.Dict(parts) if len(parts) > 1 else next(iter(parts.values()))

    def feature_space(self) -> gymnasium.Space[Any]:
        """The space of the feature observation."""
        if self.described_features is None:
            return spaces.Box(-np.inf, np.inf, (len(self.features),), np.float32)
        return _space(self.described_features)

    def feature_observation(self, features: NDArray[np.float32]) -> Any:
        """Features, float32 (..., features), as observations of the feature space, without a copy where that is a Box."""
        return features if self.described_features is None else _observation(self.described_features, features)

    def single_observation(self, features: NDArray[np.float32]) -> Any:
        """The feature observation of one environment, with the original's types: integers of Discrete spaces are Python's."""
        return _single(self.feature_observation(features), self.types.integers)

    def state_space(self) -> gymnasium.Space[Any] | None:
        """The space of the Markov state, in POPGym the original's; `None` if the environment does not tell it."""
        parts = [part.gymnasium_space() for part in self.markov_state]
        return spaces.Tuple(parts) if len(parts) > 1 else next(iter(parts), None)

    def states(self, numbers: NDArray[np.float32]) -> Any:
        """States, float32 (..., k), as those of the state's space: an array, or a tuple of arrays for its parts."""
        parts = [part.values(each) for part, each in self._state_parts(numbers)]
        return tuple(parts) if len(parts) > 1 else parts[0]

    def single_state(self, numbers: NDArray[np.float32]) -> Any:
        """A state, float32 (k,), with the original's types."""
        parts = [
            int(each[0]) if part.dtype == "int" else part.values(each, part.dtype)[()]
            for part, each in self._state_parts(numbers)
        ]
        return tuple(parts) if len(parts) > 1 else parts[0]

    def _state_parts(self, numbers: NDArray[np.float32]) -> Iterable[tuple[StatePart, NDArray[np.float32]]]:
        ends = np.cumsum([part.width for part in self.markov_state])
        return zip(self.markov_state, np.split(numbers, ends[:-1], axis=-1), strict=True)

    def max_episode_steps(self, options: Mapping[str, Any]) -> int:
        """The step limit of an episode with these reset parameters, as in the original; -1 for none, and for an environment of an
        engine that this process does not have.

        Raises:
            ValueError: A reset parameter is unknown, or has the wrong type or range.
        """
        return int(self.native.max_episode_steps(self.id, options_text(options)))

    def ground_truth_space(self) -> gymnasium.Space[Any] | None:
        """The space of `info["ground_truth"]`, in Memory Gym the original's."""
        if not self.ground_truth:
            return None
        return spaces.Box(*self.ground_truth_bounds, (self.ground_truth,), np.float32)


_SPECS: dict[str, Spec] = {}


def all_specs() -> dict[str, Spec]:
    """All environments by their ids.

    Examples:
        >>> import endless_gym
        >>> endless_gym.all_specs()["MysteryPath-v0"].summary
        'Find an invisible path to the goal; the agent starts over after a fall and must remember the path'
    """
    return _SPECS


def add_specs(native: ModuleType) -> Iterable[Spec]:
    """Add the environments of a native module to `all_specs`; `endless_gym.register_envs` documents the errors."""
    if not hasattr(native, "specs"):
        raise TypeError(f"module must be a native module that `endless_gym_python::module!` defines, got {native!r}")
    if native.__version__ != _native.__version__:
        raise ValueError(
            f"{native.__name__} was built with endless-gym-python {native.__version__}, which must be the version of "
            f"endless_gym, {_native.__version__}"
        )
    found = [described_spec(described, native.__name__) for described in json.loads(native.specs())]
    for spec in found:
        known = _SPECS.get(spec.id, spec)
        if known.module != spec.module:
            raise ValueError(f"{spec.module} must not have the id {spec.id}, which {known.module} has already")
    _SPECS.update((spec.id, spec) for spec in found)
    return found


def spec(id: str) -> Spec:
    """The specification of an id, with or without the prefix `EndlessGym/`. As for `gymnasium.make`, `module:id` imports a module
    first, which registers the id. The id may have arguments, as in `popgym-RepeatPreviousEasy-v0?k=2`.

    Examples:
        >>> import endless_gym
        >>> described = endless_gym.spec("MysteryPath-Grid-v0")
        >>> [choice.name for choice in described.actions[0].choices]
        ['nothing', 'left', 'right', 'ahead']
        >>> described.reset_parameters["max_steps"]
        128

    Raises:
        TypeError: The id is not a string.
        ValueError: The module cannot be imported, or there is no such id; the message has the likely ids, or all. Or an argument
            is unknown or out of its range.
    """
    if not isinstance(id, str):
        raise TypeError(f"id must be a string, got {id!r}")
    module, _, name = id.rpartition(":")
    try:
        if module:
            import_module(module)
    except ImportError as error:
        raise ValueError(f"id must name a module that can be imported, got {id!r}: {error}") from error
    name, _, arguments = name.removeprefix("EndlessGym/").partition("?")
    if name not in _SPECS:
        if likely := _native.likely_ids(name, list(_SPECS)):
            raise ValueError(f"id must be one of endless_gym.all_specs(), got {id!r}; did you mean {likely}?")
        raise ValueError(f"id must be one of {', '.join(_SPECS)}, got {id!r}")
    return _with_arguments(name, arguments) if arguments else _SPECS[name]


@cache
def _with_arguments(id: str, arguments: str) -> Spec:
    module = _SPECS[id].native
    return described_spec(json.loads(module.spec(f"{id}?{arguments}")), module.__name__)


def with_arguments(id: str, given: dict[str, Any]) -> str:
    """The id with those of its arguments that are given, which are removed from `given`."""
    values = {name: given.pop(name) for name in spec(id).arguments if name in given}
    texts = (f"{name}={value if isinstance(value, str) else json_text(value)}" for name, value in values.items())
    return f"{id}{'&' if '?' in id else '?'}{'&'.join(texts)}" if values else id


def contents(described: Spec, observation: ObservationName | None, frames: Frames | None) -> tuple[Frames | None, bool]:
    """The format of the frames, `None` without frames, and whether a batch has the feature observation."""
    if observation is None:
        observation = described.default_observation
    if not isinstance(observation, str) or observation not in OBSERVATIONS:
        raise ValueError(f"observation must be one of {', '.join(OBSERVATIONS)}, got {observation!r}")
    if frames is not None and not isinstance(frames, Frames):
        raise TypeError(f"frames must be endless_gym.Frames or None, got {frames!r}")
    has_frames, has_features = OBSERVATIONS[observation]
    if described.frame is None and (has_frames or frames is not None):
        given = f'observation="{observation}"' if has_frames else f"frames={frames}"
        raise ValueError(f'{described.id} has no frames; use observation="features" without frames, got {given}')
    if frames is not None and not has_frames:
        raise ValueError(f"frames must be None, since the observation `{observation}` has no frames, got {frames}")
    return (frames or Frames()) if has_frames else None, has_features


def options_text(options: Mapping[str, Any] | None) -> str:
    """Reset parameters as JSON text."""
    return "{}" if not options else json_text(dict(options))


def json_text(value: Any) -> str:
    """JSON text of a value, which may contain numpy's numbers and arrays."""
    try:
        return json.dumps(value, default=_plain, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"reset parameters must be finite numbers: {error}") from error


def _plain(value: Any) -> Any:
    """Numbers and arrays of numpy as Python objects."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"reset parameters must be numbers, booleans, strings or lists, got {value!r}")


def described_spec(described: dict[str, Any], module: str = _native.__name__) -> Spec:
    """The specification that an engine publishes, or that the native module lists."""
    return Spec(
        id=described["id"],
        summary=described["summary"],
        described_actions=described["action_space"],
        actions=tuple(ActionBranch(branch["name"], _meanings(branch["choices"])) for branch in described["actions"]),
        frame=None if described["frame"] is None else tuple(described["frame"].values()),
        picture=None if described["picture"] is None else tuple(described["picture"].values()),
        vector_observation=described["vector_observation"],
        ground_truth=len(described["ground_truth"]),
        ground_truth_columns=_meanings(described["ground_truth"]),
        ground_truth_is_integer=described["ground_truth_is_integer"],
        ground_truth_bounds=tuple(described["ground_truth_bounds"] or (-np.inf, np.inf)),
        markov_state=tuple(StatePart(**{**part, "shape": tuple(part["shape"])}) for part in described["markov_state"]),
        needs_previous_action=described["needs_previous_action"],
        types=OriginalTypes(**described["types"]),
        info=tuple((column["name"], column["is_integer"]) for column in described["info"]),
        features=tuple(column["name"] for column in described["features"]),
        described_features=described["observation_space"],
        feature_columns=_meanings(described["features"]),
        reset_parameters={parameter["name"]: parameter["default"] for parameter in described["parameters"]},
        arguments={argument["name"]: argument["default"] for argument in described["arguments"]},
        metric=Metric(**described["metric"]),
        learnt=None if described["learnt"] is None else Learnt(**described["learnt"]),
        render_fps=described["render_fps"],
        module=module,
    )


def _space(described: dict[str, Any]) -> gymnasium.Space[Any]:
    """The space that an engine describes. A bound of None is infinite."""
    ((kind, value),) = described.items()
    if kind == "Discrete":
        return spaces.Discrete(value)
    if kind == "MultiDiscrete":
        return spaces.MultiDiscrete(value)
    if kind == "Tuple":
        return spaces.Tuple([_space(part) for part in value])
    return spaces.Box(_bounds(value, "low"), _bounds(value, "high"), dtype=np.float32)


def _bounds(box: dict[str, Any], name: str) -> NDArray[np.float32]:
    """The bounds `low` or `high` of a box."""
    infinity = -np.inf if name == "low" else np.inf
    return np.array([infinity if bound is None else bound for bound in box[name]], np.float32)


def _width(described: dict[str, Any]) -> int:
    """Number of numbers of a space."""
    ((kind, value),) = described.items()
    if kind == "Discrete":
        return 1
    if kind == "Tuple":
        return sum(map(_width, value))
    return len(value if kind == "MultiDiscrete" else value["low"])


def _observation(described: dict[str, Any], features: NDArray[np.float32]) -> Any:
    """The observations of a space whose numbers are the last axis."""
    ((kind, value),) = described.items()
    if kind == "Discrete":
        return features[..., 0].astype(np.int64)
    if kind == "MultiDiscrete":
        return features.astype(np.int64)
    if kind == "Box":
        return features
    ends = np.cumsum([_width(part) for part in value])
    parts = np.split(features, ends[:-1], axis=-1)
    return tuple(_observation(part, numbers) for part, numbers in zip(value, parts, strict=True))


def _single(part: Any, integers: str) -> Any:
    """An observation with the dtype of its arrays of integers, and the integer of an array without axes."""
    if isinstance(part, tuple):
        return tuple(_single(each, integers) for each in part)
    if not part.ndim:
        return part.item()
    return part.astype(integers, copy=False) if part.dtype.kind == "i" else part


def _meanings(described: Iterable[dict[str, str]]) -> tuple[Meaning, ...]:
    """Entries of the engine's table, with `name` and `description`."""
    return tuple(Meaning(each["name"], each["description"]) for each in described)


add_specs(_native)
