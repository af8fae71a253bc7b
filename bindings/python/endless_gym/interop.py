"""Arrays as tensors of other libraries, without a copy."""

from __future__ import annotations

import sys
import warnings
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


def pin_memory(array: NDArray[Any]) -> bool:
    """Page-lock the array's memory, so that `tensor.to("cuda", non_blocking=True)` is asynchronous.

    The whole mapping is page-locked, with all batches in it; one call for each group of an engine is enough. Without CUDA, this
    warns and does nothing.

    Args:
        array: Any array of a step.

    Returns:
        Whether the memory is page-locked.
    """
    reason = _pin(array)
    if reason is not None:
        warnings.warn(f"memory is not page-locked: {reason}", stacklevel=2)
    return reason is None


def mapping_of(address: int, size: int = 1) -> tuple[int, int]:
    """First address and size in bytes of the memory mappings of this process that contain `size` bytes at `address`."""
    start = None
    with open("/proc/self/maps") as maps:
        for line in maps:
            first, end = (int(number, 16) for number in line.split(maxsplit=1)[0].split("-"))
            if first <= address < end:
                start = first
            # The kernel may divide the heap into adjacent mappings.
            if start is not None and end >= address + size:
                return start, end - start
    raise ValueError(f"no mapping at address {address:#x}")


_PINNED: set[int] = set()
_READ_ONLY = 8
_ALREADY_REGISTERED = 712


def _pin(array: NDArray[Any]) -> str | None:
    """Page-locks the array's memory. Returns the reason if that fails."""
    try:
        import torch
    except ImportError:
        return "PyTorch is not installed"
    if not torch.cuda.is_available():
        return "PyTorch finds no CUDA device"
    first, size = mapping_of(array.ctypes.data, array.nbytes)
    if first in _PINNED:
        return None
    runtime = torch.cuda.cudart()
    # An engine's memory is mapped read-only, for which CUDA requires a flag.
    for flags in (_READ_ONLY, 0):
        status = int(runtime.cudaHostRegister(first, size, flags))
        if status in (0, _ALREADY_REGISTERED):
            _PINNED.add(first)
            return None
    return f"CUDA refuses to register {size} bytes, with error {status}"
