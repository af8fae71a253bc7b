"""Copies of observations that are kept up to date from what each step changes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.vector import EndlessVectorEnv

if TYPE_CHECKING:
    import torch

    from endless_gym.watching import Watch


class ObservationCopy:
    """A copy of a group's newest frames, in memory of this process and on request on a device, which moves only what has changed.

    ```python
    import endless_gym

    envs = endless_gym.make_vec("MysteryPath-v0", num_envs=256, changes=True)
    frames = endless_gym.ObservationCopy(envs)
    observation, info = envs.reset(seed=0)
    frames.update(observation)
    observation, *_ = envs.step(envs.action_space.sample())
    frames.update(observation)
    assert (frames.array == observation).all()
    ```

    An update needs the array that the environments returned, not a copy of it. An update that follows the one before by more than
    one step or reset of the group, the first one, and every update without `changes=True` copy everything. The result is the same
    in every case.

    Attributes:
        array: The frames of the last update, uint8 (n, 84, 84, 3) or in the format of the environments. It changes in place, and
            only `update` may write to it.
    """

    def __init__(
        self,
        envs: EndlessVectorEnv | Watch,
        *,
        device: str | torch.device | None = None,
        pin_memory: bool = False,
    ) -> None:
        """Make a copy, of zeros until the first `update`.

        Args:
            envs: The environments, or a watch of them.
            device: Also keep a copy on this device of PyTorch, to which an update moves only the rows that have changed.
            pin_memory: Page-lock the copy in this process, by PyTorch, which needs CUDA.

        Raises:
            ValueError: The environments have no frames.
        """
        source = envs if isinstance(envs, EndlessVectorEnv) else envs._envs
        self._updates = _native.ObservationUpdates(source._layout or "{}")
        shape = self._updates.shape()
        self._pin_memory = pin_memory
        if pin_memory:
            import torch

            self.array: NDArray[np.uint8] = torch.zeros(shape, dtype=torch.uint8, pin_memory=True).numpy()
        else:
            self.array = np.zeros(shape, dtype=np.uint8)
        self._tensor: torch.Tensor | None = None
        self._moves = device is not None
        if device is not None:
            import torch

            self._tensor = torch.zeros(shape, dtype=torch.uint8, device=device)
            self._packed = torch.zeros(
                (self.array.size // self._updates.row_bytes(), self._updates.row_bytes()),
                dtype=torch.uint8,
                pin_memory=pin_memory,
            )

    @property
    def tensor(self) -> torch.Tensor:
        """The copy as a tensor: that on the device if one was given, otherwise one that shares the memory of `array`."""
        if self._tensor is None:
            import torch

            self._tensor = torch.from_numpy(self.array)
        return self._tensor

    def update(self, observation: NDArray[np.uint8] | Mapping[str, NDArray[np.uint8]]) -> int:
        """Make the copy equal to an observation of the environments, without the interpreter's lock.

        Args:
            observation: What `reset`, `step` or `recv` returned for the group, always the same one, or what a `WatchedBatch` has:
                the array of the frames, or the dict that includes it.

        Returns:
            Bytes that were copied in this process.

        Raises:
            TypeError: The observation is not an array of these environments' memory.
        """
        frames = observation["visual_observation"] if isinstance(observation, Mapping) else observation
        if not self._moves:
            return self._updates.update(frames, self.array)
        try:
            copied, rows = self._updates.update_and_list(frames, self.array)
            self._move(rows)
        except BaseException:
            # The copy on the device may lack what the one here has.
            self._updates.forget()
            raise
        return copied

    def _move(self, rows: NDArray[np.int64]) -> None:
        """Copies rows of the array to the device."""
        import torch

        host, device = torch.from_numpy(self.array).view(self._packed.shape), self.tensor.view(self._packed.shape)
        if len(rows) == len(host):
            device.copy_(host)
        elif len(rows):
            index = torch.from_numpy(rows)
            packed = torch.index_select(host, 0, index, out=self._packed[: len(rows)])
            device.index_copy_(0, index.to(device.device), packed.to(device.device))

    def forget(self) -> None:
        """Copy everything at the next update; required after a change to `array` or `tensor` by anything else."""
        self._updates.forget()

    def __repr__(self) -> str:
        shape: Any = self.array.shape
        return f"ObservationCopy(shape={shape})"
