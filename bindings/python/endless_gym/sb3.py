"""A Stable-Baselines3 `VecEnv` without a Python loop over the environments.

```python
from sb3_contrib import RecurrentPPO
from endless_gym.sb3 import EndlessVecEnv

venv = EndlessVecEnv.make("Endless-MortarMayhem-v0", num_envs=64)
RecurrentPPO("CnnLstmPolicy", venv).learn(1_000_000)
```
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
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

from endless_gym.vector import EndlessVectorEnv, make_vec

__all__ = ["EndlessVecEnv"]


class EndlessVecEnv(VecEnv):
    """A batch of Endless Gym environments for Stable-Baselines3.

    `step` returns

    * observations: uint8 (num_envs, 84, 84, 3), or a dict of arrays if the observation space is a dict; read-only,
    * rewards: float32 (num_envs,),
    * dones: bool (num_envs,); with same-step auto-reset, an environment that is done returns the first observation of its
      next episode,
    * infos: one dict per environment. If the environment is done, it contains `terminal_observation`,
      `TimeLimit.truncated`, `episode` (`r`, `l` and `t`, as in `Monitor`) and the final infos of the original environment.
      The dict of every other environment is shared between steps and must not be modified.

    `info` is the info of the last step as the vector environment returned it, in arrays.
    """

    def __init__(self, envs: EndlessVectorEnv) -> None:
        """Wrap `envs`, made by `make_vec`, `serve` or `connect` with same-step auto-reset and one group.

        Raises:
            ValueError: Another auto-reset mode, or several groups.
        """
        mode = gymnasium.vector.AutoresetMode(envs.metadata["autoreset_mode"])
        if mode is not gymnasium.vector.AutoresetMode.SAME_STEP:
            raise ValueError(f'Stable-Baselines3 needs autoreset="same_step", got {mode.name.lower()!r}')
        if envs.num_groups != 1:
            raise ValueError(f"Stable-Baselines3 needs one group of environments, got {envs.num_groups} groups")
        self.envs = envs
        self._actions: np.ndarray | None = None
        self.info: dict[str, Any] = {}
        self._running: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(envs.num_envs)]
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        # Stable-Baselines3 converts observations to tensors, for which PyTorch warns about read-only arrays, and only reads them.
        # The filter applies to its modules only.
        module = r"(stable_baselines3|sb3_contrib)\."
        warnings.filterwarnings("ignore", "The given NumPy array is not writ", UserWarning, module)

    @classmethod
    def make(cls, env_id: str, num_envs: int, **kwargs: Any) -> EndlessVecEnv:
        """Make `num_envs` environments; `kwargs` are those of `make_vec`."""
        return cls(make_vec(env_id, num_envs=num_envs, autoreset="same_step", **kwargs))

    def reset(self) -> VecEnvObs:
        """Start an episode in every environment, with the seeds of `seed` and the options of `set_options`."""
        options = self._options[0]
        if any(other != options for other in self._options):
            raise ValueError("all environments of a batch must have the same options, got different ones")
        seeds = None if self._seeds[0] is None else list(self._seeds)
        observations: VecEnvObs
        observations, self.info = self.envs.reset(seed=seeds, options=options or None)
        self.reset_infos = [_row(self.info, index) for index in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Store integer `actions`, (num_envs,) or (num_envs, 2), for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all environments with the actions of `step_async`."""
        observations, rewards, terminated, truncated, self.info = self.envs.step(self._actions)
        dones = np.logical_or(terminated, truncated)
        infos = self._running.copy()
        for index in np.flatnonzero(dones).tolist():
            infos[index] = _final_row(self.info, index)
            infos[index]["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the attribute of the batch once for each of `indices`; it is the same for all environments."""
        value = getattr(self.envs, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Not supported: the environments of a batch have no individual attributes."""
        raise NotImplementedError(
            f"cannot set {attr_name!r}: the environments of a batch have no individual attributes; use set_options"
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Not supported: the environments of a batch have no individual methods."""
        raise NotImplementedError(
            f"cannot call {method_name!r}: the environments of a batch have no individual methods"
        )

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Return true for `Monitor`, whose `episode` statistics are in the infos, and false for other wrappers."""
        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]

    def _get_indices(self, indices: VecEnvIndices) -> Iterable[int]:
        return range(self.num_envs) if indices is None else [indices] if isinstance(indices, int) else indices


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
