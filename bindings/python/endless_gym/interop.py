"""The arrays as other libraries' tensors, without a copy."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from endless_gym import _native

if TYPE_CHECKING:
    import torch


class DLPackView:
    """An array for `from_dlpack` of any library: `jax.dlpack.from_dlpack(DLPackView(observation))`.

    The tensor shares the array's memory and keeps it alive. DLPack's common version cannot say that memory is read-only: do not
    write to such a tensor.
    """

    def __init__(self, array: NDArray[Any]) -> None:
        self._array = array

    def __dlpack__(self, **_: Any) -> Any:
        """The capsule of DLPack's protocol."""
        return _native.dlpack(self._array)

    def __dlpack_device__(self) -> tuple[int, int]:
        """The processor."""
        return (1, 0)


def torch_view(array: NDArray[Any]) -> torch.Tensor:
    """A tensor that shares the array's memory and keeps it alive.

    As `torch.from_numpy`, but without its warning that a read-only array makes a tensor that must not be written to.
    """
    from torch.utils.dlpack import from_dlpack

    tensor: torch.Tensor = from_dlpack(_native.dlpack(array))
    return tensor


def pin_memory(array: NDArray[Any]) -> bool:
    """Page-locks the memory that the array lies in, so that `tensor.to("cuda", non_blocking=True)` copies while others work.

    The whole mapping is locked, with all batches in it: once for each group of an engine's environments is enough. Without CUDA
    this warns once and does nothing.

    Args:
        array: Any array of a step.

    Returns:
        Whether the memory is page-locked now.
    """
    reason = _pin(array)
    if reason is not None:
        warnings.warn(f"memory is not page-locked: {reason}", stacklevel=2)
    return reason is None


def mapping_of(address: int) -> tuple[int, int]:
    """First address and size of the mapping of this process in which `address` lies."""
    with open("/proc/self/maps") as maps:
        for line in maps:
            first, end = (int(number, 16) for number in line.split(maxsplit=1)[0].split("-"))
            if first <= address < end:
                return first, end - first
    raise ValueError(f"no mapping at address {address:#x}")


_PINNED: set[int] = set()
_READ_ONLY = 8
_ALREADY_REGISTERED = 712


def _pin(array: NDArray[Any]) -> str | None:
    """Page-locks, or says why not."""
    try:
        import torch
    except ImportError:
        return "PyTorch is not installed"
    if not torch.cuda.is_available():
        return "PyTorch finds no CUDA device"
    first, size = mapping_of(array.ctypes.data)
    if first in _PINNED:
        return None
    runtime = torch.cuda.cudart()
    # What an engine maps is read-only here, which CUDA wants to be told.
    for flags in (_READ_ONLY, 0):
        status = int(runtime.cudaHostRegister(first, size, flags))
        if status in (0, _ALREADY_REGISTERED):
            _PINNED.add(first)
            return None
    return f"CUDA refuses to register {size} bytes, with error {status}"
