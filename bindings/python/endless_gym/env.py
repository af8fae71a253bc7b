"""One environment with the interface of the original's class."""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.arguments import integer, mapping
from endless_gym.meanings import documented, metadata
from endless_gym.specs import all_specs, options_text, spec

Observation = NDArray[np.uint8] | dict[str, NDArray[Any]]

#: Ids whose ground truth is an integer array in the original.
_INTEGER_GROUND_TRUTH = ("Endless-MysteryPath-v0",)

#: Side of the ground-truth view in pixels.
_VIEW = 336


@documented(all_specs().values())
class Env(gymnasium.Env[Any, Any]):
    """A Memory Gym environment: observations, rewards, flags and infos are bit-exact to the original.

    Observations are uint8 (84, 84, 3), indexed `[x][y][channel]` as in the original; the ids with `MortarMayhemB` return a dict
    of `visual_observation` and `vector_observation` (float32 (180,)). Every step returns newly allocated arrays.

    `metadata["actions"]`, `metadata["ground_truth"]` and `metadata["features"]` say what the numbers mean.

    As in the original, an episode shows what the one before has left: the first frames of Endless-MortarMayhem show the last
    episode's character until the agent may move, so that `reset(seed=...)` alone does not decide them. An episode depends on its
    seed and its options alone with `independent_episodes`.

    Args:
        id: Environment id, such as `MortarMayhem-v0`.
        render_mode: `rgb_array`: `render` returns the frame, uint8 (84, 84, 3); `debug_rgb_array`: the ground-truth view, uint8
            (336, 336, 3); both indexed `[row][column][channel]`. `human`: every step shows that view in a window (needs pygame).
        options: Reset parameters for every episode. Options of `reset` override them.
        independent_episodes: Start every episode as in a new environment, and draw a seed for each episode that is given none.

    Raises:
        ValueError: The id or the render mode is unknown, or a reset parameter is unknown or out of its range.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's
        "render_modes": ["human", "rgb_array", "debug_rgb_array"],
        "render_fps": 25,
    }

    def __init__(
        self,
        id: str,
        render_mode: str | None = None,
        options: dict[str, Any] | None = None,
        *,
        independent_episodes: bool = False,
    ) -> None:
        self._spec = spec(id)
        if render_mode not in (None, *self.metadata["render_modes"]):
            known = ", ".join(self.metadata["render_modes"])
            raise ValueError(f"render_mode must be None or one of {known}, got {render_mode!r}")
        # The frame rate and the meanings differ from id to id.
        fps = {"render_fps": self._spec.render_fps}
        self.metadata = {**type(self).metadata, **fps, **metadata(self._spec)}  # type: ignore[misc]
        self.render_mode = render_mode
        self.action_space = self._spec.action_space()
        self.observation_space = self._spec.observation_space()
        self.has_ground_truth_info = self._spec.ground_truth > 0
        if self.has_ground_truth_info:
            self.ground_truth_space = self._spec.ground_truth_space()
        self._truth_dtype = np.int64 if self._spec.id in _INTEGER_GROUND_TRUTH else np.float64
        self._options = mapping("options", options)
        self._native = _native.Single(self._spec.id, options_text(self._options), bool(independent_episodes))
        self._seed: int | None = None
        self._window: _Window | None = None
        self._is_shown = False
        self._was_reset = False
        #: Reset parameters of the current episode, the defaults included.
        self.reset_params: dict[str, Any] = {**self._spec.reset_parameters, **self._options}

    @property
    def max_episode_steps(self) -> int:
        """The step limit of an episode with the current reset parameters, as in the original; -1 for none."""
        return self._spec.max_episode_steps(self.reset_params)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the environment's generator, passed to `numpy.random.default_rng`. `None` continues the generator.
            options: Reset parameters by the original's names, which override those given to the constructor.

        Raises:
            ValueError: The seed is out of its range, or a reset parameter is unknown or out of its range.
        """
        seed = None if seed is None else integer("seed", seed)
        super().reset(seed=seed)
        given = {**self._options, **mapping("options", options)}
        arrays = self._native.reset(seed, options_text(given))
        self.reset_params = {**self._spec.reset_parameters, **given}
        self._seed = seed
        self._was_reset = True
        self._is_shown = False
        if self.render_mode == "human":
            self._show()
        return self._observation(arrays), self._info(arrays)

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Play one step. As in the original, `terminated` reports every end of an episode, also by the step limit.

        Raises:
            ResetNeeded: The environment has not been reset.
            TypeError: The action is not an integer or a sequence of integers.
            ValueError: The action is out of its range.
        """
        if not self._was_reset:
            raise ResetNeeded("call `env.reset()` before `env.step()`")
        arrays, reward, terminated, end = self._native.step(action)
        info = self._info(arrays)
        if end is not None:
            info["reward"], info["length"], values = end
            for (name, is_integer), value in zip(self._spec.info, values, strict=True):
                info[name] = int(value) if is_integer else value
        self._is_shown = False
        if self.render_mode == "human":
            self._show()
        return self._observation(arrays), reward, terminated, False, info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """The current frame or view of the render mode; `None` for `human` and without a render mode."""
        if self.render_mode == "rgb_array":
            return self._native.rgb_array()
        if self.render_mode == "debug_rgb_array":
            return self._native.ground_truth_view()
        if self.render_mode == "human":
            # `reset` and `step` show the picture, as Gymnasium requires; in the original only `render` does.
            self._show()
        return None

    def snapshot(self) -> bytes:
        """The complete state, including the generator, which `restore` accepts."""
        return self._native.snapshot()

    def restore(self, snapshot: bytes) -> tuple[Observation, dict[str, Any]]:
        """Restore the state from a snapshot of an environment with the same id. Returns the observation and the info.

        Raises:
            ValueError: It is not a snapshot of that id.
        """
        arrays = self._native.restore(snapshot)
        self._was_reset = True
        self._is_shown = False
        return self._observation(arrays), self._info(arrays)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _show(self) -> None:
        """Shows the current picture once: each call of the ground-truth view advances a shown clue."""
        if self._is_shown:
            return
        if self._window is None:
            self._window = _Window()
        self._window.show(self._native.ground_truth_view(), f"{self._spec.id}, seed {self._seed}")
        self._window.wait(self.metadata["render_fps"])
        self._is_shown = True

    def _observation(self, arrays: _native.SingleArrays) -> Observation:
        if arrays[1] is None:
            return arrays[0]
        return {"visual_observation": arrays[0], "vector_observation": arrays[1]}

    def _info(self, arrays: _native.SingleArrays) -> dict[str, Any]:
        return {} if arrays[2] is None else {"ground_truth": arrays[2].astype(self._truth_dtype, copy=False)}


class _Window:
    """A window that shows pictures, by pygame."""

    def __init__(self) -> None:
        try:
            import pygame
        except ImportError as error:
            raise ImportError(
                "render_mode=\"human\" needs pygame: pip install './bindings/python[render]', or the wheel file with `[render]` "
                "appended"
            ) from error
        self._pygame = pygame
        pygame.display.init()
        self._screen = pygame.display.set_mode((_VIEW, _VIEW))
        self._next = time.monotonic()

    def show(self, picture: NDArray[np.uint8], title: str) -> None:
        self._pygame.display.set_caption(title)
        self._pygame.surfarray.blit_array(self._screen, picture.swapaxes(0, 1))
        self._pygame.display.flip()
        self._pygame.event.pump()

    def wait(self, fps: int) -> None:
        time.sleep(max(0.0, self._next - time.monotonic()))
        self._next = time.monotonic() + 1 / fps

    def close(self) -> None:
        self._pygame.display.quit()
