"""Arrays as tensors of other libraries, without a copy."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from endless_gym import _native

if TYPE_CHECKING:
    import torch

#: DLPack's device type and number of the CPU, where all arrays are.
_CPU = (1, 0)

#: Whether numpy can mark read-only arrays, which DLPack supports since version 1.0.
_NUMPY_HAS_FLAG = np.lib.NumpyVersion(np.__version__) >= "2.1.0"


class DLPackView:
    """Exports an array to `from_dlpack` of any library: `jax.dlpack.from_dlpack(DLPackView(observation))`.

    The tensor shares the array's memory and keeps it alive. A library that supports DLPack 1.0 receives read-only arrays with the
    read-only flag, which numpy sets from 2.1 on. For other libraries, and for PyTorch, which ignores the flag, the tensor is
    writable if the environments are in this process. The next frames in that memory are then drawn in full, so that writes do no
    harm; this costs time. Arrays of environments in another process are not exported to such libraries: use `torch_view` for
    PyTorch, or `DLPackView(array.copy())`.
    """

    def __init__(self, array: NDArray[Any]) -> None:
        self._array = array

    def __dlpack__(
        self,
        *,
        stream: Any = None,
        max_version: tuple[int, int] | None = None,
        dl_device: tuple[int, int] | None = None,
        copy: bool | None = None,
    ) -> Any:
        """The capsule of the DLPack protocol.

        Raises:
            BufferError: The array is read-only memory of another process and the library does not support read-only arrays, or
                a device other than the CPU is requested.
        """
        if dl_device is not None and (int(dl_device[0]), int(dl_device[1])) != _CPU:
            raise BufferError(f"dl_device must be the CPU, {_CPU}, got {dl_device}")
        array = self._array.copy() if copy else self._array
        if array.flags.writeable:
            return array.__dlpack__()
        is_torch = sys._getframe(1).f_globals.get("__name__") == "torch.utils.dlpack"
        if max_version is not None and max_version[0] >= 1 and not is_torch and _NUMPY_HAS_FLAG:
            return array.__dlpack__(max_version=max_version)
        if not _native.note_export(array):
            raise BufferError(
                "the array is read-only, and the consumer does not support DLPack's read-only flag; export a copy: array.copy()"
            )
        return _native.writable_view(array).__dlpack__()

    def __dlpack_device__(self) -> tuple[int, int]:
        """The CPU."""
        return _CPU


def torch_view(array: NDArray[Any]) -> torch.Tensor:
    """A tensor that shares the array's memory and keeps it alive.

    Only read it: PyTorch has no read-only tensors. A write to the memory of environments in this process corrupts later frames;
    a write to that of environments in another process kills this process. `tensor.clone()` is a writable copy.

    Raises:
        TypeError: PyTorch has no counterpart of the array's dtype.
    """
    import torch

    return torch.from_numpy(_native.writable_view(array))


def mapping_of(address: int, size: int = 1) -> tuple[int, int]:
    """First address and size in bytes of the memory mappings of this process that contain `size` bytes at `address`."""
    start, last = None, 0
    with open("/proc/self/maps") as maps:
        for line in maps:
            first, end = (int(number, 16) for number in line.split(maxsplit=1)[0].split("-"))
            if first <= address < end:
                start = first
            elif start is not None and first != last:
                break
            last = end
            # The kernel may divide the heap into adjacent mappings.
            if start is not None and end >= address + size:
                return start, end - start
    raise ValueError(f"no mapping at address {address:#x}")


_READ_ONLY = 8


def cuda_to_pin(pin_memory: bool, copy: bool) -> Any:
    """`torch.cuda` for the arguments of an environment; `None` without `pin_memory`, and with a warning without a device.

    Raises:
        ValueError: Copies cannot be in page-locked memory.
    """
    if not pin_memory:
        return None
    if copy:
        raise ValueError(
            "pin_memory page-locks the memory that the engine writes, and copy=True copies out of it; omit one"
        )
    try:
        import torch
    except ImportError:
        reason = "PyTorch is not installed"
    else:
        if torch.cuda.is_available():
            return torch.cuda
        reason = "PyTorch finds no CUDA device"
    warnings.warn(f"memory is not page-locked: {reason}", stacklevel=3)
    return None


def page_locked_bytes() -> Callable[[int], torch.Tensor]:
    """Allocates tensors of page-locked zeros, uint8 (bytes,), without running Python code."""
    import torch

    return functools.partial(torch.zeros, dtype=torch.uint8, pin_memory=True)


class PageLocks:
    """Page-locks the shared memory of an engine's groups, one mapping each, until `release`.

    CUDA would keep reading the old pages if other memory were mapped at the same address in the meantime. So an array of each
    mapping is kept, which keeps the mapping.
    """

    def __init__(self, cuda: Any) -> None:
        """`cuda` is `torch.cuda`."""
        self._cuda, self._process = cuda, os.getpid()
        # By group; `None` for one whose memory cannot be page-locked.
        self._locked: dict[int, tuple[int, NDArray[Any]] | None] = {}

    def lock(self, group: int, arrays: Sequence[NDArray[Any]]) -> None:
        """Page-lock a group's memory at its first batch, of which these are the arrays."""
        if group in self._locked:
            return
        array = next(array for array in arrays if not array.flags.owndata)
        first, size = mapping_of(array.ctypes.data, array.nbytes)
        # Before the call, after which a signal handler may raise.
        self._locked[group] = first, array
        # The memory is mapped read-only, for which CUDA requires a flag on most systems.
        for flags in (_READ_ONLY, 0):
            status = int(self._cuda.cudart().cudaHostRegister(first, size, flags))
            if status == 0:
                return
        self._locked[group] = None
        # PyTorch reports CUDA's last error in the next operation.
        import torch

        with contextlib.suppress(RuntimeError):
            torch.zeros(1, device="cuda")
        warnings.warn(f"memory is not page-locked: CUDA refuses {size} bytes, with error {status}", stacklevel=3)

    def release(self) -> None:
        """Wait for the copies from the memory, and unlock it."""
        locked, self._locked = [each for each in self._locked.values() if each is not None], {}
        if not locked or self._process != os.getpid():
            return
        for device in range(self._cuda.device_count()):
            # A device without memory is the target of no copy, and waiting for it would initialise it.
            if self._cuda.memory_reserved(device):
                self._cuda.synchronize(device)
        for first, _ in locked:
            self._cuda.cudart().cudaHostUnregister(first)
