"""The original environments, and the recording of their episodes. Needs memory-gym 1.0.2 or 1.0.3 on Python 3.11."""

import os
import warnings
import zlib
from collections.abc import Iterable
from typing import Any

warnings.filterwarnings("ignore")
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"

import gymnasium  # noqa: E402
import memory_gym  # noqa: E402, F401
import numpy  # noqa: E402


class Original:
    """One environment object of the original, which can play several episodes in a row."""

    def __init__(self, env_id: str, options: dict[str, Any]) -> None:
        self.env: Any = gymnasium.make(env_id, disable_env_checker=True, render_mode="debug_rgb_array").unwrapped
        self.options = options
        self._is_endless_path = env_id == "Endless-MysteryPath-v0"

    @property
    def parameters(self) -> set[str]:
        """Names of the reset parameters that the installed version has."""
        return set(self.env.default_reset_parameters)

    def episode(
        self, seed: int | None, actions: Iterable[Any], views: bool = False, frames: list[Any] | None = None
    ) -> dict[str, Any]:
        """Play one episode, until it is done or there are no more actions, and return its record.

        Args:
            seed: Seed of the reset; None continues the object's random generator.
            actions: Integers or lists of integers, each requested when the environment is ready for it.
            views: Whether to record the checksum of the ground-truth view with each step.
            frames: A list to which the observations, uint8 (84, 84, 3), are appended.
        """
        observation, info = self.env.reset(seed=seed, options=dict(self.options))
        if self._is_endless_path:
            self.env.start = _Start((self.env.start.x, self.env.start.y))
        frame = _frame(observation)
        frames = [] if frames is None else frames
        frames.append(frame)
        steps: list[list[Any]] = []
        episode = {"seed": seed, "reset_crc": _checksum(frame), "reset_info": _plain(info), "steps": steps}
        if isinstance(observation, dict):
            episode["reset_vector"] = _plain(observation["vector_observation"])
        for action in actions:
            observation, reward, done, _, info = self.env.step(action)
            frame = _frame(observation)
            frames.append(frame)
            steps.append([action, float(reward), bool(done), _checksum(frame), _plain(info)])
            if views:
                steps[-1].append(_checksum(self.env.render()))
            if done:
                break
        return episode


class _Start(tuple[int, int]):
    """The first tile of an endless path, which equals its coordinates.

    Version 1.0.2 compares the node itself with a pair of numbers, so that the first tile counts as progress; 1.0.3
    compares its coordinates. This makes 1.0.2 behave like 1.0.3.
    """

    x = property(lambda self: self[0])
    y = property(lambda self: self[1])


def _frame(observation: Any) -> Any:
    return observation["visual_observation"] if isinstance(observation, dict) else observation


def _checksum(array: Any) -> int:
    return zlib.crc32(numpy.ascontiguousarray(array).tobytes())


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, numpy.ndarray)):
        return [_plain(item) for item in value]
    value = value.item() if isinstance(value, numpy.generic) else value
    return None if value != value else value  # JSON has no NaN.
