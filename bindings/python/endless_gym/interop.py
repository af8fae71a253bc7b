"""Zero-copy conversion of arrays to tensors of other libraries, and page-locking of their memory."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from endless_gym import _native

if TYPE_CHECKING:
    import torch


class DLPackView:
    """Wraps an array for the `from_dlpack` function of any library: `jax.dlpack.from_dlpack(DLPackView(observation))`.

    The tensor shares the memory of the array and keeps it alive. The common version of DLPack cannot express that memory is
    read-only: do not write to such a tensor.
    """

    def __init__(self, array: NDArray[Any]) -> None:
        self._array = array

    def __dlpack__(self, **_: Any) -> Any:
        """The DLPack capsule."""
        return _native.dlpack(self._array)

    def __dlpack_device__(self) -> tuple[int, int]:
        """The device: the CPU."""
        return (1, 0)


def torch_view(array: NDArray[Any]) -> torch.Tensor:
    """Return a tensor that shares the memory of the array and keeps it alive.

    Like `torch.from_numpy`, but without the warning for read-only arrays. Do not write to a tensor of a read-only array.
    """
    from torch.utils.dlpack import from_dlpack

    tensor: torch.Tensor = from_dlpack(_native.dlpack(array))
    return tensor


def pin_memory(array: NDArray[Any]) -> bool:
    """Page-lock the memory of the array, so that `tensor.to("cuda", non_blocking=True)` copies asynchronously.

    The whole memory mapping is locked, with all batches in it, so one call per group of an engine's environments is sufficient.
    Without CUDA this warns and does nothing.

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
    """Start address and size in bytes of the memory mapping of this process that contains `address`.

    Raises:
        ValueError: There is no such mapping.
    """
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
    """Page-lock the mapping of the array; returns None, or the reason why it failed."""
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
    # Shared memory of an engine is mapped read-only, which needs a flag of its own in CUDA.
    for flags in (_READ_ONLY, 0):
        status = int(runtime.cudaHostRegister(first, size, flags))
        if status in (0, _ALREADY_REGISTERED):
            _PINNED.add(first)
            return None
    return f"cudaHostRegister failed for {size} bytes with error {status}"
