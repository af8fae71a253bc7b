"""Graphs on the CPU that behave as those of CUDA, for tests without a GPU.

* Capturing executes nothing: whatever the captured operations wrote is undone, and their results are no numbers until a replay.
* A replay repeats the operations, with their arguments as they were, on the same memory, without any Python of the captured
  function.
* Memory from outside that the graph reads or writes is not kept: a replay after it was freed is an error. CUDA would read what is
  there by then.
* An operation that waits for the device, and access to the numbers of a tensor, cannot be captured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from operations import VIEWS
from other_device import WAITING
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves, tree_map_only

#: Numbers that no test expects.
POISON = 77


class Weak:
    """A tensor whose memory is not kept."""

    def __init__(self, tensor: torch.Tensor) -> None:
        self.storage = StorageWeakRef(tensor.untyped_storage())
        self.dtype, self.place = tensor.dtype, (tensor.storage_offset(), tensor.size(), tensor.stride())

    def tensor(self) -> torch.Tensor:
        storage = torch.UntypedStorage._new_with_weak_ptr(self.storage.cdata)
        if storage is None:
            raise RuntimeError(f"the graph uses memory that was freed, of a tensor of shape {tuple(self.place[1])}")
        return torch.empty(0, dtype=self.dtype).set_(storage, *self.place)


@dataclass
class Recording(TorchDispatchMode):
    """Context that executes operations and records them."""

    calls: list[tuple[Any, Any, Any, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()
        # The memory that the operations allocate, and what they overwrite of other memory, by address of the storage.
        self._own: dict[int, torch.Tensor] = {}
        self._overwritten: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, kwargs = operation.overloadpacket.__name__, kwargs or {}
        if name in WAITING:
            raise RuntimeError(f"{name} waits for the device, which cannot be captured")
        for index, argument in enumerate(operation._schema.arguments):
            if argument.alias_info is not None and argument.alias_info.is_write:
                self._keep(args[index] if index < len(args) else kwargs[argument.name])
        result = operation(*args, **kwargs)
        before = {self._address(tensor) for tensor in tensors_of((args, kwargs))}
        for tensor in tensors_of(result):
            if self._address(tensor) not in before:
                self._own[self._address(tensor)] = tensor
        if name not in VIEWS:
            self.calls.append((operation, *tree_map_only(torch.Tensor, self._argument, (args, kwargs, result))))
        return result

    def finish(self) -> None:
        """Undo what the operations wrote."""
        for tensor, kept in self._overwritten.values():
            whole(tensor).copy_(kept)
        for tensor in self._own.values():
            whole(tensor).fill_(POISON)

    def _keep(self, tensor: torch.Tensor) -> None:
        address = self._address(tensor)
        if address not in self._own and address not in self._overwritten:
            self._overwritten[address] = (tensor, whole(tensor).clone())

    def _argument(self, tensor: torch.Tensor) -> torch.Tensor | Weak:
        return tensor if self._address(tensor) in self._own else Weak(tensor)

    @staticmethod
    def _address(tensor: torch.Tensor) -> int:
        return tensor.untyped_storage()._cdata


def tensors_of(values: Any) -> list[torch.Tensor]:
    return [leaf for leaf in tree_leaves(values) if isinstance(leaf, torch.Tensor)]


def whole(tensor: torch.Tensor) -> torch.Tensor:
    """The bytes of a tensor's storage."""
    return torch.empty(0, dtype=torch.uint8).set_(tensor.untyped_storage())


class RecordedGraphs:
    """Stands in for `endless_gym.agents.graphs.CudaGraphs`.

    Attributes:
        captures: Number of operations in each graph, without those that only make a view.
        replays: Number of replays.
    """

    def __init__(self) -> None:
        self.captures: list[int] = []
        self.replays = 0

    def warm_up(self, function: Callable[[], None]) -> None:
        for _ in range(2):
            function()

    def capture(self, function: Callable[[], None]) -> Callable[[], None]:
        numpy = torch.Tensor.numpy
        torch.Tensor.numpy = refuse
        recording = Recording()
        try:
            with recording:
                function()
        finally:
            torch.Tensor.numpy = numpy
        recording.finish()
        calls = recording.calls
        self.captures.append(len(calls))
        del recording

        @torch.no_grad()
        def replay() -> None:
            self.replays += 1
            # One launch, whatever a test counts.
            with _disable_current_modes():
                for operation, args, kwargs, result in calls:
                    args, kwargs, result = tree_map_only(Weak, Weak.tensor, (args, kwargs, result))
                    for place, value in zip(tensors_of(result), tensors_of(operation(*args, **kwargs)), strict=True):
                        if place.untyped_storage()._cdata != value.untyped_storage()._cdata:
                            place.copy_(value)

        return replay


def refuse(*args: Any, **kwargs: Any) -> None:
    raise RuntimeError("the numbers of a tensor cannot be read while a graph is captured")
