"""One environment with the interface of the original's class."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.arguments import integer, mapping
from endless_gym.display.descriptions import documented, metadata
from endless_gym.display.keyboard import keys_to_action
from endless_gym.display.rendering import SINGLE_MODES, TEXT_MODES, SnapshotRenderer, View, checked_view, modes_of
from endless_gym.display.window import Window, WindowClosed
from endless_gym.specs import Frames, ObservationName, all_specs, contents, json_text, options_text, spec

Observation = NDArray[Any] | int | tuple[Any, ...] | dict[str, NDArray[Any]]

#: The types of rewards: functions of the reward and of whether the step ended the episode.
_REWARDS: dict[str, Callable[[float, bool], float]] = {
    "float": lambda reward, ended: reward,
    "numpy_float": lambda reward, ended: np.float64(reward),
    "numpy_float_if_positive": lambda reward, ended: np.float64(reward) if reward > 0 else reward,
    "integer_zero": lambda reward, ended: reward or 0,
    "integer_zero_until_end": lambda reward, ended: reward if ended else reward or 0,
}


@cache
def popgym_class() -> type[Env]:
    """An `Env` that is a `popgym.core.env.POPGymEnv`, which POPGym's wrappers require; an `Env` without the package `popgym`."""
    registered = dict(gymnasium.registry)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from popgym.core.env import POPGymEnv
    except ImportError:
        return Env
    # The package registers its own environments, also by ids that `register` may have registered before.
    gymnasium.registry.update(registered)
    return type("PopgymEnv", (Env, POPGymEnv), {"__doc__": Env.__doc__})


def _made(kind: type[Env], id: str) -> Env:
    """An environment whose state is to be restored."""
    return kind.__new__(kind, id)


@documented(spec for spec in all_specs().values() if spec.frame)
class Env(gymnasium.Env[Any, Any]):
    """An environment of Memory Gym or POPGym, bit-exact to the original, or one of `register_envs`.

    Observations of Memory Gym are uint8 (84, 84, 3), indexed `[x][y][channel]` as in the original; the ids with `MortarMayhemB`
    return a dict of `visual_observation` and `vector_observation` (float32 (180,)). Every step returns newly allocated arrays.

    `metadata["actions"]`, `metadata["ground_truth"]` and `metadata["features"]` contain the meanings of the numbers.

    As in the original, an episode can show traces of the previous one: the first frames of Endless-MortarMayhem show the last
    episode's character until the agent may move, so `reset(seed=...)` alone does not determine them. With
    `independent_episodes`, an episode depends only on its seed and its options.
    Where the package `popgym` is installed, environments that tell their Markov state are its `POPGymEnv`s.

    `copy.deepcopy` and `pickle` make an independent environment that continues identically: they copy the state of the episode
    and of the generator, but no window.

    Examples:
        >>> import endless_gym
        >>> env = endless_gym.Env("MortarMayhem-Grid-v0", options={"command_count": [1]})
        >>> observation, info = env.reset(seed=1)
        >>> observation.shape, observation.dtype, env.action_space
        ((84, 84, 3), dtype('uint8'), Discrete(4))

    Args:
        id: Environment id, such as `MortarMayhem-v0`.
        render_mode: `rgb_array`: `render` returns the frame, uint8 (84, 84, 3); `debug_rgb_array`: the ground-truth view, uint8
            (336, 336, 3); both indexed `[row][column][channel]`. `human`: every step shows that view in a window (needs pygame).
            Without frames, these show the picture of the observation.
            `ansi`, in environments without frames and only there: what the agent sees as text, such as `suit hearts`.
        options: Reset parameters for every episode. Options of `reset` override them.
        observation: `rgb` for frames, `features` for a vector that describes what the frame shows, or `rgb+features` for a dict
            of both, as for `make_vec`. `None` for frames, or features in environments without frames.
        frames: Format of the frames, as for `make_vec`. `None` for the original's format, which `render` always uses.
        view: What `rgb_array` and `human` show instead of the above: `agent` for the frame, `ground_truth` for the ground-truth
            view, for tools that know only Gymnasium's own render modes.
        independent_episodes: Start every episode as in a new environment, and draw a seed for each episode that is given none.

    Raises:
        TypeError: `frames` is not `Frames`.
        ValueError: The id, the render mode or the observation is unknown, or a reset parameter is unknown or out of its range.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's
        "render_modes": [*SINGLE_MODES, *TEXT_MODES],
        "render_fps": 25,
    }

    def __new__(cls, *args: Any, **kwargs: Any) -> Env:
        id = args[0] if args else kwargs.get("id")
        tells_state = cls is Env and isinstance(id, str) and spec(id).markov_state
        return super().__new__(popgym_class() if tells_state else cls)

    def __init__(
        self,
        id: str,
        render_mode: str | None = None,
        options: dict[str, Any] | None = None,
        *,
        observation: ObservationName | None = None,
        frames: Frames | None = None,
        view: View | None = None,
        independent_episodes: bool = False,
    ) -> None:
        self._spec = spec(id)
        modes = modes_of(self._spec, SINGLE_MODES)
        self._view = checked_view(render_mode, view, modes)
        self._frames, self._features = contents(self._spec, observation, frames)
        self._independent_episodes = bool(independent_episodes)
        # Render modes, frame rate and meanings differ from id to id.
        rendering = {"render_modes": list(modes), "render_fps": self._spec.render_fps}
        self.metadata = {**type(self).metadata, **rendering, **metadata(self._spec)}  # type: ignore[misc]
        self.render_mode = render_mode
        self.action_space = self._spec.action_space()
        self.observation_space = self._spec.observation_space(self._frames, self._features)
        self.has_ground_truth_info = self._spec.ground_truth > 0
        if self.has_ground_truth_info:
            self.ground_truth_space = self._spec.ground_truth_space()
        #: The space of `get_state`, in POPGym the original's; `None` if the environment does not tell its state.
        self.state_space = self._spec.state_space()
        #: Whether the best policy needs the previous action, which the observation does not show.
        self.obs_requires_prev_action = self._spec.needs_previous_action
        self._truth_dtype = np.int64 if self._spec.ground_truth_is_integer else np.float64
        self._numpy_floats = self._spec.types.numpy_floats
        self._options = mapping("options", options)
        self._native = self._new_native()
        self._renderer: SnapshotRenderer | None = None
        self._seed: int | None = None
        self._window: Window | None = None
        self._is_shown = False
        self._was_closed = False
        self._was_reset = False
        #: Reset parameters of the current episode, the defaults included.
        self.reset_params: dict[str, Any] = {**self._spec.reset_parameters, **self._options}

    @property
    def max_episode_steps(self) -> int:
        """The step limit of an episode with the current reset parameters, as in the original; -1 for none."""
        return self._spec.max_episode_steps(self.reset_params)

    def progress(self) -> dict[str, tuple[float, float | None]]:
        """The progress of the episode, such as `{"tiles": (2.0, 9.0), "falls": (1.0, None)}`.

        Returns:
            By name, the current value and the value at which the task is complete, or `None` if there is no such value.

        Raises:
            RuntimeError: The environment has not been reset.
        """
        return {name: (value, of) for name, value, of in self._native.progress()}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Examples:
            >>> env = Env("MysteryPath-Grid-v0")
            >>> observation, info = env.reset(seed=1, options={"show_goal": True})
            >>> env.reset_params["show_goal"], env.max_episode_steps
            (True, 128)

        Args:
            seed: Seed of the environment's generator, passed to `numpy.random.default_rng`. `None` continues the generator.
            options: Reset parameters by the original's names, which override those given to the constructor.

        Raises:
            ValueError: The seed is out of its range, or a reset parameter is unknown or out of its range.
            RuntimeError: The render mode is `human` and there is no display.
            WindowClosed: The user has closed the window. No episode was started.
        """
        self._check_window()
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
        """Play one step. As in the originals, `terminated` reports every end of an episode of Memory Gym, also by the step limit,
        and `truncated` the time limits of POPGym.

        Examples:
            >>> env = Env("MortarMayhem-Grid-v0", options={"command_count": [1]})
            >>> observation, info = env.reset(seed=1)
            >>> terminated = False
            >>> while not terminated:
            ...     observation, reward, terminated, truncated, info = env.step(0)
            >>> reward, info
            (0.0, {'reward': 0.0, 'length': 10, 'success': 1, 'commands_completed': np.float64(1.0), 'task_progress': 0.0})

        Raises:
            ResetNeeded: The environment has not been reset.
            TypeError: The action is not an integer or a sequence of integers.
            ValueError: The action is out of its range.
            WindowClosed: The user has closed the window. No step was played.
        """
        self._check_window()
        if not self._was_reset:
            raise ResetNeeded("call `env.reset()` before `env.step()`")
        arrays, reward, terminated, truncated, end = self._native.step(action)
        info = self._info(arrays)
        if end is not None:
            info["reward"], info["length"], values = end
            for (name, is_integer), value in zip(self._spec.info, values, strict=True):
                info[name] = int(value) if is_integer else np.float64(value) if name in self._numpy_floats else value
        reward = _REWARDS[self._spec.types.reward](reward, end is not None)
        self._is_shown = False
        if self.render_mode == "human":
            self._show()
        return self._observation(arrays), reward, terminated, truncated, info

    def get_state(self) -> Any:
        """The hidden Markov state, an element of `state_space`, in POPGym the original's.

        Examples:
            >>> env = Env("popgym-RepeatPreviousEasy-v0")
            >>> observation, info = env.reset(seed=1)
            >>> env.state_space
            Tuple(MultiDiscrete([4 4 4 4]), Box(0.0, 1.0, (4,), float32))
            >>> env.get_state()[0].tolist() == [0, 0, 0, observation]
            True

        Raises:
            ResetNeeded: The environment has not been reset.
            NotImplementedError: The environment does not tell its state.
        """
        state = self._native.state()
        if state is None:
            raise NotImplementedError(f"{self._spec.id} does not tell its Markov state")
        if not self._was_reset:
            raise ResetNeeded("call `env.reset()` before `env.get_state()`")
        return self._spec.single_state(state)

    def render(self) -> Any:
        """The current frame, view or text of the render mode; `None` for `human` and without a render mode."""
        if self.render_mode == "human":
            # `reset` and `step` show the picture, as Gymnasium requires; in the original only `render` does.
            self._check_window()
            self._show()
            return None
        return None if self._view is None else self._picture()

    def get_keys_to_action(self) -> dict[tuple[int, ...] | str, Any]:
        """The actions of the keys W, A, S, D and the arrow keys, for `gymnasium.utils.play.play`."""
        return keys_to_action(self._spec)

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
        """Close the window, if there is one. The environment can still be used; it then opens another."""
        self._was_closed = False
        if self._window is not None:
            self._window.close()
            self._window = None

    def __reduce__(self) -> tuple[Any, ...]:
        # Whether it is a `POPGymEnv` depends on the process.
        kind = Env if type(self) is popgym_class() else type(self)
        return _made, (kind, self._spec.full_id), self.__getstate__()

    def __getstate__(self) -> dict[str, Any]:
        left_out = ("_native", "_window", "_was_closed", "_renderer")
        state = {name: value for name, value in self.__dict__.items() if name not in left_out}
        return {**state, "saved": self._native.save()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        saved = state.pop("saved")
        self.__dict__.update(state)
        self._window, self._was_closed, self._renderer = None, False, None
        self._native = self._new_native()
        if saved is not None:
            self._native.resume(*saved)

    def _new_native(self) -> _native.Single:
        config = {
            "id": self._spec.id,
            "num_envs": 1,
            "options": self._options,
            "autoreset": "disabled",
            "frames": None if self._frames is None else self._frames.configuration(),
            "features": self._features,
            "independent_episodes": self._independent_episodes,
            "state": True,
        }
        single: _native.Single = self._spec.native.Single(json_text(config))
        return single

    def _check_window(self) -> None:
        """Raises `WindowClosed` if the user has closed the window."""
        if self._window is not None and self._window.is_closed_by_user():
            self.close()
            self._was_closed = True
        if self._was_closed:
            raise WindowClosed("the window was closed; call `env.close()`, after which `env.reset()` opens another one")

    def _picture(self) -> Any:
        if self._view == "text":
            return self._native.text()
        if self._view == "ground_truth":
            # In the original, each picture in this mode advances the clue that is shown. The other modes show the current step's.
            return self._native.ground_truth_view(self.render_mode != "debug_rgb_array")
        if self._frames == Frames() or self._spec.frame is None:
            return self._native.rgb_array()
        if self._renderer is None:
            self._renderer = SnapshotRenderer(self._spec.id, "agent")
        return self._renderer.render([self.snapshot()])[0]

    def _show(self) -> None:
        """Shows the current picture once, at the original's frame rate."""
        if self._is_shown:
            return
        if self._window is None:
            self._window = Window()
        self._window.show(self._picture(), f"{self._spec.id}, seed {self._seed}")
        self._window.wait(self.metadata["render_fps"])
        self._is_shown = True

    def _observation(self, arrays: _native.SingleArrays) -> Observation:
        frames, features, vector, _ = arrays
        if features is not None:
            features = self._spec.single_observation(features)
        parts = {"visual_observation": frames, "features": features, "vector_observation": vector}
        given = {key: array for key, array in parts.items() if array is not None}
        return given if len(given) > 1 else next(iter(given.values()))

    def _info(self, arrays: _native.SingleArrays) -> dict[str, Any]:
        truth = arrays[3]
        return {} if truth is None else {"ground_truth": truth.astype(self._truth_dtype, copy=False)}
