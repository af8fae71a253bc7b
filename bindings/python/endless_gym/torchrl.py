"""An `EndlessVectorEnv` as a TorchRL environment with batch size [num_envs].

```python
from endless_gym.torchrl import EndlessEnv

env = EndlessEnv.make("MysteryPath-Grid-v0", num_envs=64)
data = env.rollout(128, break_when_any_done=False)    # batch size [64, 128]
```
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

try:
    import torch
    from tensordict import TensorDict, TensorDictBase
    from torchrl.data import Bounded, Categorical, Composite, MultiCategorical, TensorSpec, Unbounded
    from torchrl.envs import EnvBase
except ImportError as error:
    raise ImportError("endless_gym.torchrl needs TorchRL: pip install torchrl tensordict") from error

from endless_gym import torch_view
from endless_gym.create import make_vec
from endless_gym.engine import serve
from endless_gym.vector import EndlessVectorEnv, check_adaptable

__all__ = ["EndlessEnv"]


class EndlessEnv(EnvBase):  # type: ignore[misc]
    """An `EndlessVectorEnv` as a TorchRL environment with batch size [num_envs].

    Entries, with shapes after the batch dimension:

    * `observation`: uint8 (84, 84, 3); if the observation space is a dict, one entry for each of its keys,
    * `action`: int64 () for Discrete, (branches,) for MultiDiscrete spaces,
    * `reward`: float32 (1,); `done`, `terminated`, `truncated`: bool (1,),
    * `ground_truth`: float64 (k,), if the original has it,
    * `("final_info", NAME)`: the original's final infos, such as `success` or `commands_completed`, float64 (1,), or int64 (1,)
      for integers; also `reward`, float64 (1,), and `length`, int64 (1,), of the episode. Zeros where no episode ends.

    At the end of an episode, `next` holds its last observation. `rollout` and collectors then reset the environment. On the CPU,
    observations are copied, since TorchRL stores them and transforms may modify them in place; to other devices they are
    transferred without an intermediate copy.

    `step` and `reset` raise the same exceptions as those of `EndlessVectorEnv`.
    """

    def __init__(
        self, envs: EndlessVectorEnv | gymnasium.vector.VectorWrapper, device: torch.device | str = "cpu"
    ) -> None:
        """Wrap `envs`, made by `make_vec`, `serve` or `connect` with disabled auto-reset and one group, and maybe wrapped.

        Raises:
            ValueError: The environments have another auto-reset mode, or several groups.
        """
        described = check_adaptable(envs, gymnasium.vector.AutoresetMode.DISABLED, "TorchRL")._described
        super().__init__(device=device, batch_size=[envs.num_envs])
        self.envs = envs
        self._seed: int | None = None
        space = envs.single_observation_space
        spaces = space.spaces if isinstance(space, gymnasium.spaces.Dict) else {"observation": space}
        batch = self.batch_size
        entries = {key: _observation_spec(space, batch, self.device) for key, space in spaces.items()}
        if described.ground_truth:
            entries["ground_truth"] = Unbounded(
                shape=(*batch, described.ground_truth), dtype=torch.float64, device=self.device
            )
        self._final = {name: torch.int64 if is_integer else torch.float64 for name, is_integer in described.info}
        self._final |= {"reward": torch.float64, "length": torch.int64}
        final = {
            name: Unbounded(shape=(*batch, 1), dtype=dtype, device=self.device) for name, dtype in self._final.items()
        }
        entries["final_info"] = Composite(final, shape=batch, device=device)
        self.observation_spec = Composite(entries, shape=batch, device=device)
        self.action_spec = _action_spec(envs.single_action_space, batch, self.device)
        self.reward_spec = Unbounded(shape=(*batch, 1), dtype=torch.float32, device=self.device)
        flag = Categorical(2, shape=torch.Size((*batch, 1)), dtype=torch.bool, device=self.device)
        self.done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=batch, device=self.device
        )

    @classmethod
    def make(cls, env_id: str, num_envs: int, device: torch.device | str = "cpu", **kwargs: Any) -> EndlessEnv:
        """Make `num_envs` environments; `kwargs` are those of `make_vec`."""
        return cls(make_vec(env_id, num_envs=num_envs, autoreset="disabled", **kwargs), device=device)

    @classmethod
    def serve(cls, env_id: str, num_envs: int, device: torch.device | str = "cpu", **kwargs: Any) -> EndlessEnv:
        """Start an engine process with `num_envs` environments; `kwargs` are those of `endless_gym.serve`."""
        return cls(serve(env_id, num_envs=num_envs, autoreset="disabled", **kwargs), device=device)

    @classmethod
    def workers(
        cls, env_id: str, num_envs: int, num_workers: int, device: torch.device | str = "cpu", **kwargs: Any
    ) -> list[Callable[[], EndlessEnv]]:
        """Functions for the processes of a `MultiCollector`, each of which starts an engine with its share of the environments.

        The environments are numbered over all workers, so with `seed` they play the same episodes as in one process. Do not call
        the collector's `set_seed`, which seeds each worker independently.

        Args:
            env_id: The environment id.
            num_envs: Total number of environments of all workers.
            num_workers: Number of workers.
            device: Device of the tensors.
            **kwargs: Those of `endless_gym.serve`.

        Raises:
            ValueError: `num_envs` is not a multiple of `num_workers`.
        """
        if num_workers < 1 or num_envs < 1 or num_envs % num_workers:
            raise ValueError(
                f"num_envs must be a positive multiple of num_workers, got {num_envs} environments and {num_workers} workers"
            )
        share = num_envs // num_workers
        return [
            functools.partial(cls.serve, env_id, share, device, first_env=first, total_envs=num_envs, **kwargs)
            for first in range(0, num_envs, share)
        ]

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or bool(mask.all()):
            observations, info = self.envs.reset(seed=self._seed)
            self._seed = None
        else:
            mask = mask.reshape(self.batch_size).cpu().numpy()
            observations, info = self.envs.reset(options={"reset_mask": mask})
        return TensorDict(
            {**self._to_tensors(observations), **self._infos(info), **self.full_done_spec.zero()},
            batch_size=self.batch_size,
            device=self.device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        actions = tensordict.get("action").cpu().numpy()
        observations, reward, terminated, truncated, info = self.envs.step(actions)
        return TensorDict(
            {
                **self._to_tensors(observations),
                **self._infos(info),
                "reward": torch.tensor(reward, dtype=torch.float32, device=self.device).unsqueeze(-1),
                "done": torch.tensor(np.logical_or(terminated, truncated), device=self.device).unsqueeze(-1),
                "terminated": torch.tensor(terminated, device=self.device).unsqueeze(-1),
                "truncated": torch.tensor(truncated, device=self.device).unsqueeze(-1),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed

    def close(self, **kwargs: Any) -> None:
        """Close the environments."""
        super().close(**kwargs)
        self.envs.close()

    def _infos(self, info: dict[str, Any]) -> dict[str, Any]:
        """The entries `ground_truth` and `final_info`. A vector environment has final infos only in steps that end episodes."""
        zeros = np.zeros(self.batch_size[0])
        final = {
            name: torch.tensor(info.get(name, zeros), dtype=dtype, device=self.device).unsqueeze(-1)
            for name, dtype in self._final.items()
        }
        entries: dict[str, Any] = {"final_info": TensorDict(final, batch_size=self.batch_size, device=self.device)}
        if "ground_truth" in info:
            entries["ground_truth"] = torch.tensor(info["ground_truth"], device=self.device)
        return entries

    def _to_tensors(self, observations: np.ndarray | dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
        if not isinstance(observations, dict):
            observations = {"observation": observations}
        return {key: self._copied_to_device(array) for key, array in observations.items()}

    def _copied_to_device(self, array: np.ndarray) -> torch.Tensor:
        """Convert an observation to a tensor that shares no memory with the engine."""
        if array.flags.writeable:
            return torch.from_numpy(array).to(self.device)
        return torch_view(array).to(self.device, copy=True)


def _observation_spec(space: gymnasium.Space[Any], batch: torch.Size, device: torch.device) -> TensorSpec:
    if isinstance(space, gymnasium.spaces.Discrete):
        return Categorical(int(space.n), shape=batch, device=device)
    if isinstance(space, gymnasium.spaces.MultiDiscrete):
        return MultiCategorical(space.nvec.tolist(), shape=torch.Size((*batch, *space.shape)), device=device)
    assert isinstance(space, gymnasium.spaces.Box)
    dtype = torch.from_numpy(np.empty(0, space.dtype)).dtype
    if not space.is_bounded():
        return Unbounded(shape=(*batch, *space.shape), dtype=dtype, device=device)
    low, high = torch.as_tensor(space.low, device=device), torch.as_tensor(space.high, device=device)
    return Bounded(low, high, shape=space.shape, dtype=dtype, device=device).expand(*batch, *space.shape)


def _action_spec(space: gymnasium.Space[Any], batch: torch.Size, device: torch.device) -> TensorSpec:
    if not isinstance(space, gymnasium.spaces.MultiDiscrete):
        return _observation_spec(space, batch, device)
    # All branches have the same number of choices, so a Categorical with one more dimension describes them.
    (values,) = set(space.nvec.tolist())
    return Categorical(values, shape=torch.Size((*batch, len(space.nvec))), device=device)
