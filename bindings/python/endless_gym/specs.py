"""What is fixed about each environment id: spaces, reset parameters, infos."""

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

SCREEN = 84

#: The environment id that programs use by default.
DEFAULT_ENV_ID = _native.DEFAULT_ENV_ID


@dataclass(frozen=True)
class Frames:
    """What the frames of an observation look like. The default is the original's: uint8 (84, 84, 3), [x][y][channel].

    The engine writes them so, with nothing to convert afterwards, and only the pixels that change.
    """

    #: Brightness instead of colours, without an index for the channel, as Gymnasium's `GrayscaleObservation`.
    grayscale: bool = False
    #: The channel is the first index of a frame, as PyTorch's convolutions want it.
    channels_first: bool = False
    #: [row][column] instead of [x][y].
    row_major: bool = False
    #: The last frames of the episode in one observation, oldest first, 1 to 64; with more than 1 they are the first index, as in
    #: Gymnasium's `FrameStackObservation`. An episode's first frame stands for those before it.
    stack: int = 1

    def shape(self) -> tuple[int, ...]:
        """Shape of one environment's observation."""
        channels = () if self.grayscale else (3,)
        frame = (*channels, SCREEN, SCREEN) if self.channels_first else (SCREEN, SCREEN, *channels)
        return frame if self.stack == 1 else (self.stack, *frame)

    def arguments(self) -> tuple[bool, bool, bool, int]:
        """As the native module takes it."""
        return self.grayscale, self.channels_first, self.row_major, self.stack

    def command(self) -> list[str]:
        """As `endless serve` takes it."""
        flags = {
            "--grayscale": self.grayscale,
            "--channels-first": self.channels_first,
            "--row-major": self.row_major,
        }
        return [*(flag for flag, given in flags.items() if given), f"--frame-stack={self.stack}"]

    @staticmethod
    def of_specification(described: dict[str, Any] | None) -> Frames | None:
        """What an engine says that it serves."""
        return None if described is None else Frames(**described["format"], stack=described["stack"])


@dataclass(frozen=True)
class Spec:
    """An environment id, as the engine describes it."""

    id: str
    summary: str
    #: Choices of each branch; one branch without `multi_discrete` is a Discrete space.
    branches: tuple[int, ...]
    multi_discrete: bool
    vector_observation: int
    ground_truth: int
    #: Names of the final infos beside `reward` and `length`, and whether the original's number is an int.
    info: tuple[tuple[str, bool], ...]
    #: Names of the feature observation's columns.
    features: tuple[str, ...]
    #: Reset parameters with their defaults.
    reset_parameters: dict[str, Any]
    render_fps: int

    def action_space(self) -> gymnasium.Space[Any]:
        """The original's action space."""
        if self.multi_discrete:
            return spaces.MultiDiscrete(list(self.branches))
        return spaces.Discrete(self.branches[0])

    def observation_space(self, frames: Frames | None = Frames(), features: bool = False) -> gymnasium.Space[Any]:
        """The original's observation space, or with the feature observation instead of or beside the frames."""
        parts: dict[str, gymnasium.Space[Any]] = {}
        if frames is not None:
            parts["visual_observation"] = spaces.Box(0, 255, frames.shape(), np.uint8)
        if features:
            parts["features"] = spaces.Box(-np.inf, np.inf, (len(self.features),), np.float32)
        if self.vector_observation:
            parts["vector_observation"] = spaces.Box(0, 1, (self.vector_observation,), np.float32)
        return spaces.Dict(parts) if len(parts) > 1 else next(iter(parts.values()))

    def max_episode_steps(self, options: Mapping[str, Any]) -> int:
        """Steps after which an episode with these reset parameters ends; -1 for none. As in the original.

        Raises:
            ValueError: A reset parameter has no value of its kind.
        """
        parameters = {**self.reset_parameters, **options}
        try:
            if "max_steps" in parameters:
                return int(parameters["max_steps"])
            # Mortar Mayhem: clue and execution of the most commands at their slowest.
            longest = {name: max(value) for name, value in parameters.items() if isinstance(value, (list, tuple))}
            clue = longest.get("command_show_duration", 0) + longest.get("command_show_delay", 0)
            execution = longest["explosion_duration"] + longest["explosion_delay"]
            return int((clue + execution) * longest["command_count"] - longest["explosion_duration"] + 1)
        except (KeyError, OverflowError, TypeError, ValueError):
            raise ValueError(
                f"no episode's length follows from {dict(options)}: `max_steps` is a number, and what tells of commands and "
                "explosions is a list of numbers"
            ) from None

    def ground_truth_space(self) -> gymnasium.Space[Any] | None:
        """The original's space of `info["ground_truth"]`."""
        if not self.ground_truth:
            return None
        return spaces.Box(0, 1, (self.ground_truth,), np.float32)


@cache
def all_specs() -> dict[str, Spec]:
    """All environments by their ids."""
    return {described["id"]: _spec(described) for described in json.loads(_native.specs())}


def spec(id: str) -> Spec:
    """The environment of that id, with or without the prefix `EndlessGym/`.

    Raises:
        ValueError: There is none; the message lists those that there are.
    """
    known = all_specs()
    name = id.removeprefix("EndlessGym/")
    if name not in known:
        raise ValueError(f"no environment `{id}`; there are {', '.join(known)}")
    return known[name]


def options_text(options: Mapping[str, Any] | None) -> str:
    """Reset parameters as the engine reads them."""
    return "{}" if not options else json_text(dict(options))


def json_text(value: Any) -> str:
    """JSON, also of numpy's numbers and arrays."""
    return json.dumps(value, default=_plain)


def _plain(value: Any) -> Any:
    """What JSON does not know: numpy's numbers and arrays."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"{value!r} cannot be the value of a reset parameter")


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
