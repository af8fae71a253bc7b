"""PufferLib adapter: one native `PufferEnv` that contains all environments.

```python
import pufferlib.vector
from endless_gym.pufferlib import EndlessPufferEnv

kwargs = {"env_id": "MysteryPath-Grid-v0", "num_envs": 1024}
vecenv = pufferlib.vector.make(EndlessPufferEnv, env_kwargs=kwargs)
```
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

try:
    from pufferlib import PufferEnv
except ImportError as error:
    raise ImportError(
        f"endless_gym.pufferlib needs PufferLib 3.0 and its imports ({error}): pip install psutil gym-notices; "
        "pip install --no-deps pufferlib==3.0.0 gym==0.26.2 pettingzoo shimmy; see examples/pufferlib_rollout.py"
    ) from error

from endless_gym.create import make_vec
from endless_gym.specs import DEFAULT_ENV_ID

__all__ = ["EndlessPufferEnv"]


class EndlessPufferEnv(PufferEnv):  # type: ignore[misc]
    """All environments as one native `PufferEnv`; `num_agents` is `num_envs`.

    Arrays: `observations` uint8 (num_envs, 84, 84, 3), `rewards` float32 (num_envs,), `terminals`, `truncations` and `masks`
    bool (num_envs,). With the buffers that PufferLib passes, observations are copied into them. Without buffers (backend
    `PufferEnv`), `observations` is replaced after each step by a read-only view of the batch.

    Auto-reset is same-step: where a terminal or truncation is set, the observation is the first of the next episode. The infos
    are empty, or contain one dict with a list for each statistic of the episodes that ended in this step: `episode_return`,
    `episode_length`, and the final infos of the original environment.
    """

    def __init__(
        self,
        env_id: str = DEFAULT_ENV_ID,
        num_envs: int = 64,
        buf: dict[str, np.ndarray] | None = None,
        seed: int | None = None,
        **kwargs: Any,
    ) -> None:
        """Make `num_envs` environments. PufferLib passes `buf` and `seed`; `kwargs` are those of `make_vec`.

        Raises:
            ValueError: The observation is a dict.
        """
        self.envs = make_vec(
            env_id, num_envs=num_envs, seed=_first_seed(seed, num_envs), autoreset="same_step", **kwargs
        )
        self.single_observation_space = self.envs.single_observation_space
        self.single_action_space = self.envs.single_action_space
        if not isinstance(self.single_observation_space, gymnasium.spaces.Box):
            self.envs.close()
            raise ValueError(
                f"PufferEnv supports only Box observations, and {env_id} has a dict; "
                "choose another id, or one kind of observation"
            )
        self.num_agents = num_envs
        self._owns_buffers = buf is None
        super().__init__(buf)

    def reset(self, seed: int | None = None) -> tuple[np.ndarray, list[dict[str, Any]]]:
        """Start an episode in every environment; environment `i` is seeded with `seed * num_envs + i`.

        PufferLib passes consecutive seeds to its environments; with this seeding no two of them play the same episodes.

        Returns:
            The observations, and an empty list of infos.

        Raises:
            ValueError: The seed is out of its range.
        """
        observations, _ = self.envs.reset(seed=_first_seed(seed, self.num_agents))
        self._store_observations(observations)
        self.rewards[:] = 0
        self.terminals[:] = False
        self.truncations[:] = False
        self.masks[:] = True
        return self.observations, []

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, list[dict[str, list[float]]]]:
        """Step all environments.

        Args:
            actions: Integers, (num_envs,) for Discrete and (num_envs, branches) for MultiDiscrete.

        Returns:
            The arrays that the class describes, `observations`, `rewards`, `terminals` and `truncations`, and the infos.

        Raises:
            TypeError: The actions are not integers.
            ValueError: The actions have another shape, or one is out of its range. No environment was stepped.
            RuntimeError: The environments have not been reset.
        """
        observations, rewards, terminated, truncated, info = self.envs.step(actions)
        self._store_observations(observations)
        self.rewards[:] = rewards
        self.terminals[:] = terminated
        self.truncations[:] = truncated
        infos = [_statistics(info)] if terminated.any() or truncated.any() else []
        return self.observations, self.rewards, self.terminals, self.truncations, infos

    def notify(self) -> None:
        """Does nothing; part of PufferLib's interface."""

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def _store_observations(self, observations: np.ndarray) -> None:
        if self._owns_buffers:
            self.observations = observations
        else:
            np.copyto(self.observations, observations)


def _first_seed(seed: int | None, num_envs: int) -> int | None:
    return None if seed is None else seed * num_envs


def _statistics(info: dict[str, Any]) -> dict[str, list[float]]:
    """Return the statistics in a vector environment's `info` of the episodes that have just ended."""
    ended, final = info["_final_info"], info["final_info"]
    statistics = {"episode_return": final["reward"], "episode_length": final["length"]}
    for key, values in final.items():
        if not key.startswith("_") and values.ndim == 1:
            statistics[key] = values
    return {key: values[ended].tolist() for key, values in statistics.items()}
