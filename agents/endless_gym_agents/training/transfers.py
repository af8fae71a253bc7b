"""Copies between the host and the agent's device.

Copies to and from a device other than the CPU are asynchronous if the host's memory is page-locked, as that of environments made
with `pin_memory` is. CUDA first copies other memory. On the CPU, NumPy makes the copies, since its calls cost less.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from endless_gym.interop import torch_view


def host_tensor(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """An uninitialised tensor on the host for copies to or from `device`, page-locked unless that is the CPU."""
    return torch.empty(shape, dtype=dtype, pin_memory=device.type != "cpu")


class _Copies:
    """Copies on the current stream of a device."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._module = None if device.type == "cpu" else torch.get_device_module(device)
        self._done = None if self._module is None else self._module.Event()

    def _begin(self, source: Tensor, target: Tensor) -> None:
        target.copy_(source, non_blocking=True)
        if self._module is not None and self._done is not None:
            # The current device may be another one.
            self._done.record(self._module.current_stream(self._device))

    def wait(self) -> None:
        """Wait until the copies that were begun are complete."""
        if self._done is not None:
            self._done.synchronize()


class HostCopy(_Copies):
    """A copy of a device tensor on the host: `start` begins the copy, and `wait` waits for it.

    Attributes:
        array: The copy on the host, valid after `wait` and until the next `start`.
    """

    def __init__(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
        """Allocate the memory on the host."""
        super().__init__(device)
        self._tensor = host_tensor(shape, dtype, device)
        self.array: NDArray[Any] = self._tensor.numpy()

    def start(self, tensor: Tensor) -> None:
        """Begin to copy `tensor`; later operations on the same stream do not delay the copy."""
        self._begin(tensor, self._tensor)


class Upload(_Copies):
    """Copies of host arrays on a device. The arrays must not change, and are kept, until `wait` returns.

    The engine does not write to the memory of arrays that are kept.
    """

    def __init__(self, device: torch.device) -> None:
        """Prepare for copies to `device`."""
        super().__init__(device)
        self._kept: list[NDArray[Any]] = []

    def copy(self, array: NDArray[Any], target: Tensor) -> None:
        """Begin to copy `array` to `target`, of equal shape."""
        if self._done is None:
            np.copyto(target.numpy(), array)
            return
        self._kept.append(array)
        self._begin(torch_view(array), target)

    def tensor(self, array: NDArray[Any]) -> Tensor:
        """A tensor on the device to which `array` is being copied; on the CPU, one that shares its memory."""
        view = torch_view(array)
        if self._done is None:
            return view
        target = torch.empty_like(view, device=self._device)
        self.copy(array, target)
        return target

    def wait(self) -> None:
        """Wait until the copies that were begun are complete, and release their arrays."""
        super().wait()
        self._kept.clear()
