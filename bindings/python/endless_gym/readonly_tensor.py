"""PyTorch tensors that share memory with a batch, and that cannot be written to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
import torch
from numpy.typing import NDArray

_MESSAGE = "this tensor shares the memory of a batch and is read-only; write to a copy: tensor.clone()"


class ReadOnlyTensor(torch.Tensor):
    """A tensor that operations can read but not write.

    It has no storage of its own. `__torch_dispatch__` passes the tensor of the shared memory to an operation, unless the schema
    of the operation says that it writes to that argument. Results that share the storage are read-only as well; all other results
    are plain tensors.
    Native code that bypasses the dispatcher gets an exception instead of the storage. `data_ptr()` returns the address of the
    shared memory, for comparisons: it must not be written to.
    """

    _shared: torch.Tensor

    # Methods return what `__torch_dispatch__` returns.
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls: type[ReadOnlyTensor], shared: torch.Tensor) -> ReadOnlyTensor:
        if torch.is_inference_mode_enabled():
            # PyTorch cannot make views of an ordinary tensor that are inference tensors.
            with torch.inference_mode(False):
                return ReadOnlyTensor(shared)
        tensor: ReadOnlyTensor = torch.Tensor._make_wrapper_subclass(
            cls,
            shared.size(),
            strides=shared.stride(),
            storage_offset=shared.storage_offset(),
            dtype=shared.dtype,
            device=shared.device,
        )
        # Native code that bypasses `__torch_dispatch__` then raises, instead of using a null pointer.
        torch._C._set_throw_on_mutable_data_ptr(tensor)
        tensor._shared = shared
        return tensor

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls,
        func: Any,
        types: tuple[type, ...],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        kwargs = kwargs or {}
        for index, name in _written(func):
            if _storages(args[index] if index < len(args) else kwargs.get(name)):
                raise RuntimeError(_MESSAGE)
        # By storage, since some operations return aliases that their schemas do not declare, and others only sometimes an alias.
        storages = _storages([*args, *kwargs.values()])
        return _wrap(func(*map(_unwrap, args), **{name: _unwrap(value) for name, value in kwargs.items()}), storages)

    def numpy(self, *, force: bool = False) -> NDArray[Any]:
        """A read-only array of the same memory."""
        array: NDArray[Any] = self._shared.numpy()
        array.flags.writeable = False
        return array

    def tolist(self) -> Any:
        """The numbers as Python objects, in nested lists."""
        return self._shared.tolist()

    def data_ptr(self) -> int:
        """The address of the first number. The memory must not be written to."""
        return self._shared.data_ptr()

    def __repr__(self, *, tensor_contents: Any = None) -> str:  # type: ignore[override]
        return f"{type(self).__name__}({self._shared!r})"

    def __format__(self, format_spec: str) -> str:
        return format(self._shared, format_spec)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        array = self.numpy()
        if copy:
            return np.array(array, dtype)
        if dtype is None or dtype == array.dtype:
            return array
        if copy is not None:
            raise ValueError(f"dtype must be {array.dtype} or None for copy=False, got {np.dtype(dtype)}")
        return array.astype(dtype)

    def __dlpack__(self, **_: Any) -> NoReturn:
        raise BufferError(f"{_MESSAGE}, or export the array with endless_gym.DLPackView")

    def __deepcopy__(self, memo: dict[int, Any]) -> torch.Tensor:
        return self._shared.clone()

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self._shared.clone().__reduce_ex__(protocol)

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise RuntimeError(_MESSAGE)

    # These reach for the storage without `__torch_dispatch__`.
    storage = untyped_storage = share_memory_ = _refuse


#: Results of `_written` by operation. A dictionary, since `torch.compile` warns of `functools.cache`.
_WRITTEN: dict[Any, tuple[tuple[int, str], ...]] = {}


def _written(func: Any) -> tuple[tuple[int, str], ...]:
    """Positions and names of the arguments that an operation writes to."""
    if func not in _WRITTEN:
        _WRITTEN[func] = tuple(
            (index, argument.name)
            for index, argument in enumerate(func._schema.arguments)
            if argument.alias_info is not None and argument.alias_info.is_write
        )
    return _WRITTEN[func]


def _mapped(function: Callable[[Any], Any], value: Any) -> Any:
    return type(value)(map(function, value)) if type(value) in (list, tuple) else value


def _unwrap(value: Any) -> Any:
    return value._shared if isinstance(value, ReadOnlyTensor) else _mapped(_unwrap, value)


def _wrap(value: Any, storages: set[int]) -> Any:
    """The result of an operation, with read-only tensors in place of those that have one of the storages."""
    if isinstance(value, torch.Tensor):
        is_shared = torch._C._has_storage(value) and value.untyped_storage()._cdata in storages
        return ReadOnlyTensor(value) if is_shared else value
    return _mapped(lambda item: _wrap(item, storages), value)


def _storages(value: Any) -> set[int]:
    """The storages of the read-only tensors in an argument, which may be a list."""
    if isinstance(value, ReadOnlyTensor):
        return {value._shared.untyped_storage()._cdata}
    if isinstance(value, (list, tuple)):
        return set().union(*map(_storages, value))
    return set()
