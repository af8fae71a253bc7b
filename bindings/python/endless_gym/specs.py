"""Static description of each environment id: spaces, reset parameters, infos."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from endless_gym import _native

#: Side of a frame in pixels.
SCREEN = 84

#: The environment id that programs use by default.
DEFAULT_ENV_ID = _native.DEFAULT_ENV_ID


@dataclass(frozen=True)
class Frames:
    """Format of the frames of an observation. The default is that of the original: uint8 (84, 84, 3), [x][y][channel].

    The engine writes frames directly in this format, and writes only the pixels that have changed.
    """

    #: Luminance instead of colours, without channel axis, as in Gymnasium's `GrayscaleObservation`.
    grayscale: bool = False
    #: The channel is the first axis of a frame, as in PyTorch's convolutions.
    channels_first: bool = False
    #: Axes [row][column] instead of [x][y].
    row_major: bool = False
    #: Number of stacked frames in one observation, oldest first, 1 to 64. With more than 1, the stack is the first axis, as in
    #: Gymnasium's `FrameStackObservation`. Before the start of an episode its first frame is repeated.
    stack: int = 1

    def shape(self) -> tuple[int, ...]:
        """Shape of one environment's observation."""
        channels = () if self.grayscale else (3,)
        frame = (*channels, SCREEN, SCREEN) if self.channels_first else (SCREEN, SCREEN, *channels)
        return frame if self.stack == 1 else (self.stack, *frame)

    def arguments(self) -> tuple[bool, bool, bool, int]:
        """The arguments of the native module."""
        return self.grayscale, self.channels_first, self.row_major, self.stack

    def command(self) -> list[str]:
        """The flags of `endless serve`."""
        flags = {
            "--grayscale": self.grayscale,
            "--channels-first": self.channels_first,
            "--row-major": self.row_major,
        }
        return [*(flag for flag, given in flags.items() if given), f"--frame-stack={self.stack}"]

    @staticmethod
    def of_specification(described: dict[str, Any] | None) -> Frames | None:
        """The format in an engine's specification; None if the engine serves no frames."""
        return None if described is None else Frames(**described["format"], stack=described["stack"])


@dataclass(frozen=True)
class Spec:
    """Static description of an environment id."""

    #: Environment id.
    id: str
    #: The task in one line.
    summary: str
    #: Number of choices of each action branch.
    branches: tuple[int, ...]
    #: Whether the action space is MultiDiscrete; otherwise it is Discrete with one branch.
    multi_discrete: bool
    #: Entries of the vector observation; 0 if there is none.
    vector_observation: int
    #: Entries of the ground truth; 0 if there is none.
    ground_truth: int
    #: Names of the final infos except `reward` and `length`, and whether the original has an int.
    info: tuple[tuple[str, bool], ...]
    #: Names of the entries of the feature observation.
    features: tuple[str, ...]
    #: Default values of the reset parameters.
    reset_parameters: dict[str, Any]
    #: Frames per second of the rendered environment.
    render_fps: int

    def action_space(self) -> gymnasium.Space[Any]:
        """The action space of the original."""
        if self.multi_discrete:
            return spaces.MultiDiscrete(list(self.branches))
        return spaces.Discrete(self.branches[0])

    def observation_space(self, frames: Frames | None = Frames(), features: bool = False) -> gymnasium.Space[Any]:
        """Observation space of one environment.

        Args:
            frames: Format of the frames; None for no frames.
            features: Whether the feature observation is included.

        Returns:
            A Dict space if there are several parts, as in the original; otherwise the space of the only part.
        """
        parts: dict[str, gymnasium.Space[Any]] = {}
        if frames is not None:
            parts["visual_observation"] = spaces.Box(0, 255, frames.shape(), np.uint8)
        if features:
            parts["features"] = spaces.Box(-np.inf, np.inf, (len(self.features),), np.float32)
        if self.vector_observation:
            parts["vector_observation"] = spaces.Box(0, 1, (self.vector_observation,), np.float32)
        return spaces.Dict(parts) if len(parts) > 1 else next(iter(parts.values()))

    def max_episode_steps(self, options: Mapping[str, Any]) -> int:
        """Step limit of an episode with these reset parameters; -1 for none. As in the original.

        Raises:
            ValueError: A reset parameter has a value of the wrong type.
        """
        parameters = {**self.reset_parameters, **options}
        try:
            if "max_steps" in parameters:
                return int(parameters["max_steps"])
            # Mortar Mayhem: the longest clue and execution phases of the largest number of commands.
            longest = {name: max(value) for name, value in parameters.items() if isinstance(value, (list, tuple))}
            clue = longest.get("command_show_duration", 0) + longest.get("command_show_delay", 0)
            execution = longest["explosion_duration"] + longest["explosion_delay"]
            return int((clue + execution) * longest["command_count"] - longest["explosion_duration"] + 1)
        except (KeyError, OverflowError, TypeError, ValueError):
            raise ValueError(
                f"the reset parameters {dict(options)} determine no episode length: `max_steps` must be a number, and the "
                "numbers and durations of commands and explosions must be lists of numbers"
            ) from None

    def ground_truth_space(self) -> gymnasium.Space[Any] | None:
        """Space of `info["ground_truth"]` in the original; None if there is no ground truth."""
        if not self.ground_truth:
            return None
        return spaces.Box(0, 1, (self.ground_truth,), np.float32)


@cache
def all_specs() -> dict[str, Spec]:
    """The specifications of all environments by id."""
    return {described["id"]: _spec(described) for described in json.loads(_native.specs())}


def spec(id: str) -> Spec:
    """The specification of an environment id, with or without the prefix `EndlessGym/`.

    Raises:
        ValueError: Unknown id; the message lists the available ids.
    """
    known = all_specs()
    name = id.removeprefix("EndlessGym/")
    if name not in known:
        raise ValueError(f"unknown environment id `{id}`; available ids: {', '.join(known)}")
    return known[name]


def options_text(options: Mapping[str, Any] | None) -> str:
    """Reset parameters as JSON text for the engine."""
    return "{}" if not options else json_text(dict(options))


def json_text(value: Any) -> str:
    """Convert a value, which may contain numpy numbers and arrays, to JSON text."""
    return json.dumps(value, default=_plain)


def _plain(value: Any) -> Any:
    """Convert numpy numbers and arrays to Python values."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"reset parameters must be JSON values or numpy numbers and arrays, got {value!r}")


def _spec(described: dict[str, Any]) -> Spec:
    ((kind, choices),) = described["action_space"].items()
    multi_discrete = kind == "MultiDiscrete"
    return Spec(
        id=described["id"],
        summary=described["summary"],
        branches=tuple(choices) if multi_discrete else (choices,),
        multi_discrete=multi_discrete,
        vector_observation=described["vector_observation"],
        ground_truth=described["ground_truth"],
        info=tuple((column["name"], column["is_integer"]) for column in described["info"]),
        features=tuple(column["name"] for column in described["features"]),
        reset_parameters={parameter["name"]: parameter["default"] for parameter in described["parameters"]},
        render_fps=described["render_fps"],
    )
