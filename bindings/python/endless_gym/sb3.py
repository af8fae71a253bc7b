"""A Stable-Baselines3 `VecEnv`. A step loops in Python only over the episodes that ended.

```python
from sb3_contrib import RecurrentPPO
from endless_gym.sb3 import EndlessVecEnv

venv = EndlessVecEnv.make("Endless-MortarMayhem-v0", num_envs=64)
RecurrentPPO("CnnLstmPolicy", venv).learn(1_000_000)
```
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np

try:
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
except ImportError as error:
    raise ImportError(
        "endless_gym.sb3 needs Stable-Baselines3: pip install stable-baselines3 (and sb3-contrib for RecurrentPPO)"
    ) from error

from endless_gym.create import make_vec
from endless_gym.vector import EndlessVectorEnv, check_adaptable

__all__ = ["EndlessVecEnv"]


class EndlessVecEnv(VecEnv):
    """An `EndlessVectorEnv` as a Stable-Baselines3 `VecEnv`.

    `step` returns

    * observations: uint8 (num_envs, 84, 84, 3), or a dict of arrays if the observation space is a dict; read-only,
    * rewards: float32 (num_envs,),
    * dones: bool (num_envs,); where true, the observation is the first of the next episode,
    * infos: one dict per environment. If the environment is done, it contains `terminal_observation`,
      `TimeLimit.truncated`, `episode` (`r`, `l` and `t`, as in `Monitor`) and the final infos of the original environment.
      The dict of an environment whose episode continues is reused in every step and must not be modified.

    `info` is the info of the last step as the vector environment returned it, in arrays.

    `step` and `reset` raise the same exceptions as those of `EndlessVectorEnv`.
    """

    def __init__(self, envs: EndlessVectorEnv | gymnasium.vector.VectorWrapper) -> None:
        """Wrap `envs`, made by `make_vec`, `serve` or `connect` with same-step auto-reset and one group, and maybe wrapped.

        Raises:
            ValueError: The environments have another auto-reset mode, several groups, or no final observations.
        """
        self._own = check_adaptable(envs, gymnasium.vector.AutoresetMode.SAME_STEP, "Stable-Baselines3")
        if not self._own.has_final_observation:
            raise ValueError(
                "the engine must write final observations for Stable-Baselines3; start it with --final-observation"
            )
        self.envs = envs
        self.metadata = envs.metadata
        self._actions: np.ndarray | None = None
        self.info: dict[str, Any] = {}
        self._has_options = False
        self._start = time.perf_counter()
        self._running: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(envs.num_envs)]
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        # Stable-Baselines3 converts observations with `torch.as_tensor`, which warns about read-only arrays, and never writes to
        # them. The warning is suppressed for its modules only.
        module = r"(stable_baselines3|sb3_contrib)\."
        warnings.filterwarnings("ignore", "The given NumPy array is not writ", UserWarning, module)

    @classmethod
    def make(cls, env_id: str, num_envs: int, **kwargs: Any) -> EndlessVecEnv:
        """Make `num_envs` environments; `kwargs` are those of `make_vec`."""
        return cls(make_vec(env_id, num_envs=num_envs, autoreset="same_step", **kwargs))

    def reset(self) -> VecEnvObs:
        """Start an episode in every environment, with the seeds of `seed` and the options of `set_options`.

        The options, one dict for all environments or one for each, apply until the next `reset`.

        Returns:
            The observations: uint8 (num_envs, 84, 84, 3), or a dict of arrays. The infos are in `reset_infos`.

        Raises:
            ValueError: A reset parameter is unknown or out of its range. The seeds and the options are forgotten.
        """
        seeds, options = self._seeds, self._options
        # As in `DummyVecEnv`, they are for one reset; also if it fails, so that the next one can succeed.
        self._reset_seeds()
        self._reset_options()
        if any(options) or self._has_options:
            self._own.set_options(options)
            self._has_options = any(options)
        observations: VecEnvObs
        observations, self.info = self.envs.reset(seed=None if seeds[0] is None else seeds)
        self.reset_infos = [_row(self.info, index) for index in range(self.num_envs)]
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Store integer `actions`, (num_envs,) for Discrete and (num_envs, branches) for MultiDiscrete, for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all environments with the actions of `step_async`.

        Returns:
            Observations, rewards, dones and infos, as the class describes.
        """
        observations, rewards, terminated, truncated, self.info = self.envs.step(self._actions)
        dones = np.logical_or(terminated, truncated)
        infos = self._running.copy()
        seconds = time.perf_counter() - self._start
        for index in np.flatnonzero(dones).tolist():
            infos[index] = _final_row(self.info, index)
            infos[index]["episode"] = {"r": infos[index]["reward"], "l": infos[index]["length"], "t": seconds}
            infos[index]["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
        return observations, rewards.astype(np.float32), dones, infos

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return the picture of each environment, uint8 (height, width, 3), in the render mode of the environments.

        Stable-Baselines3 records and shows only pictures of the render mode `rgb_array`. They are the ground-truth views if the
        environments were made with `view="ground_truth"`.
        """
        return self._own.render() or [None] * self.num_envs

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each environment of `indices`: a space, the step limit or the reset parameters of its episode
        (`max_episode_steps`, `reset_params`), or an attribute of the batch, which all environments share.
        """
        chosen = list(self._get_indices(indices))
        if attr_name in ("max_episode_steps", "reset_params"):
            each = getattr(self._own, attr_name)
            return [each[index] for index in chosen]
        own = attr_name in ("action_space", "observation_space")
        value = getattr(self if own else self._own, attr_name)
        return [value for _ in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Not supported: the environments of a batch have no individual attributes."""
        raise NotImplementedError(f"set_attr is not supported, got {attr_name!r}; use set_options for reset parameters")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Not supported: the environments of a batch have no individual methods."""
        raise NotImplementedError(
            f"env_method is not supported, got {method_name!r}; use set_options for reset parameters"
        )

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Return true for `Monitor`, whose `episode` statistics are in the infos, and false for other wrappers."""
        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]


def _final_row(info: dict[str, Any], index: int) -> dict[str, Any]:
    """Return the info of environment `index`, whose episode has ended."""
    row = _row(info, index)
    # A copy, since a view of one frame would keep the whole batch alive.
    row["terminal_observation"] = deepcopy(row.pop("final_obs"))
    final: dict[str, Any] = row.pop("final_info")
    return row | final


def _row(info: dict[str, Any], index: int) -> dict[str, Any]:
    """Return the entries of a vector environment's `info` (arrays with masks) for environment `index`."""
    row = {}
    for key, values in info.items():
        mask = info.get(f"_{key}")
        if key.startswith("_") or (mask is not None and not mask[index]):
            continue
        if isinstance(values, dict):
            row[key] = _row(values, index)
        else:
            value = values[index]
            row[key] = value.item() if isinstance(value, np.generic) else value
    return row
