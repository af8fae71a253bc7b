"""Copies between the host and the agent's device; only the copy of the actions waits.

On the CPU, NumPy makes the copies, since its calls cost less, and nothing waits. On CUDA, copies go through page-locked memory
and are asynchronous.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from endless_gym.interop import torch_view


class HostCopy:
    """A copy of a device tensor on the host: `start` begins the copy, and `wait` waits for it.

    Attributes:
        array: The copy on the host, valid after `wait` and until the next `start`.
    """

    def __init__(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
        """Allocate the memory on the host, page-locked for CUDA."""
        self._cuda = device.type == "cuda"
        self._tensor = torch.empty(shape, dtype=dtype, pin_memory=self._cuda)
        self._done = torch.cuda.Event() if self._cuda else None
        self.array: NDArray[Any] = self._tensor.numpy()

    def start(self, tensor: Tensor) -> None:
        """Begin to copy `tensor`; on CUDA, later operations on the same stream do not delay the copy."""
        self._tensor.copy_(tensor, non_blocking=True)
        if self._done is not None:
            # The tensor's device need not be the current one.
            self._done.record(torch.cuda.current_stream(tensor.device))

    def wait(self) -> None:
        """Wait until the copy is complete."""
        if self._done is not None:
            self._done.synchronize()


class Upload:
    """Copies host arrays, by name, to device tensors.

    For CUDA, the array is first copied to page-locked memory of this process. The engine's shared memory is not page-locked
    itself: it is unmapped when the engine fails, and CUDA would keep reading the old pages.
    """

    def __init__(self, device: torch.device) -> None:
        """Prepare for copies to `device`."""
        self._on_host, self._cuda = device.type == "cpu", device.type == "cuda"
        self._staged: dict[str, Tensor] = {}

    def copy(self, name: str, array: NDArray[Any], target: Tensor) -> None:
        """Begin to copy `array` to `target`, of equal shape; the array may change afterwards.

        The previous copy under this name must be complete. It is once the actions of a later step have arrived, since copies are
        executed in order.
        """
        if self._on_host:
            np.copyto(target.numpy(), array)
            return
        source = torch_view(array)
        if self._cuda:
            if name not in self._staged:
                self._staged[name] = torch.empty(source.shape, dtype=source.dtype, pin_memory=True)
            source = self._staged[name].copy_(source)
        target.copy_(source, non_blocking=True)
